"""The mount together with all poses, all lines and their heights, and the odometer's errors."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from sofjax.extraction.observation import Observation
from sofjax.geometry.camera import Camera, Mount
from sofjax.slam import SlamConfig, SofSlam
from sofjax.smoothing import Path, Smoothed, SmoothingConfig, smooth

WIDE = {"height": 0.3, "pitch": 0.1, "roll": 0.1, "yaw": 0.1}  # priors: heights, radians


def fit_jointly(
    config: SlamConfig,
    camera: Camera,
    mount: Mount,
    log: Observation,
    free: tuple[str, ...],
    rules: SmoothingConfig | None = None,
) -> Smoothed:
    """Run the filter with a mount that is nearly right, then smooth the drive with it free.

    Pairs take a line just above the floor for one on it; here every line may have a height of its
    own, by all views from all poses. The scale of the map stays the odometer's.

    **Arguments:**
    - `mount`: nearly right, as `fit_drive` finds it.
    - `free`: of height, pitch, roll and yaw.
    """
    rules = rules or SmoothingConfig(rounds=1)  # more of them change nothing of the mount
    config = eqx.tree_at(lambda c: c.motion.distance_scale_sigma, config, 0.0)
    unit = (float(mount.height), 1.0, 1.0, 1.0)
    sigma = tuple(
        WIDE[name] * u if name in free else 0.0 for name, u in zip(WIDE, unit, strict=True)
    )
    rules = dataclasses.replace(rules, mount_sigma=sigma)
    with jax.enable_x64(False):
        single = lambda tree: jax.tree.map(_single, tree)
        camera_, mount_, log_ = single(camera), single(mount), single(log)
        slam = SofSlam(config, camera_, mount_)
        state = slam.init(jax.random.key(0), log_.segments_image.valid.shape[1])
        state, info = slam.run(state, log_)
        path = Path(info.T_world_robot, info.jitter, info.bias[-1].at[0].set(0.0))
    return smooth(config, camera, mount, log, path, state.segment_map, rules)


def _single(leaf):
    leaf = jnp.asarray(leaf)
    return leaf.astype("float32") if leaf.dtype == "float64" else leaf
