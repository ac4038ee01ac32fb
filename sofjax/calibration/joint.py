"""The mount together with all poses, all lines and their heights, and the odometer's errors."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from sofjax.extraction.observation import Observation
from sofjax.geometry.camera import Camera, Mount
from sofjax.slam import SlamConfig, SofSlam
from sofjax.smoothing import Path, Smoothed, SmoothingConfig, smooth

PRIOR_SIGMA = {"height": 0.3, "pitch": 0.1, "roll": 0.1, "yaw": 0.1}  # heights, radians


def fit_jointly(
    config: SlamConfig,
    camera: Camera,
    mount: Mount,
    log: Observation,
    free: tuple[str, ...],
    smoothing: SmoothingConfig | None = None,
) -> Smoothed:
    """The drive smoothed with its mount free, after a run of the filter with the given mount.

    Pairs cannot tell a line just above the floor from one on it. Here every line may have a height
    of its own, estimated from all poses that see it. The scale of the map stays the odometer's.

    **Arguments:**
    - `mount`: nearly right, as `fit_drive` finds it.
    - `free`: of height, pitch, roll and yaw.
    """
    smoothing = smoothing or SmoothingConfig(rounds=1)  # more rounds do not change the mount
    config = eqx.tree_at(lambda c: c.motion.distance_scale_sigma, config, 0.0)
    unit = (float(mount.height), 1.0, 1.0, 1.0)
    sigma = tuple(
        PRIOR_SIGMA[name] * u if name in free else 0.0
        for name, u in zip(PRIOR_SIGMA, unit, strict=True)
    )
    smoothing = dataclasses.replace(smoothing, mount_sigma=sigma)
    with jax.enable_x64(False):
        single = lambda tree: jax.tree.map(_single, tree)
        camera_, mount_, log_ = single(camera), single(mount), single(log)
        slam = SofSlam(config, camera_, mount_)
        state = slam.init(jax.random.key(0), log_.segments_image.valid.shape[1])
        state, info = slam.run(state, log_)
        path = Path(info.T_world_robot, info.jitter, info.bias[-1].at[0].set(0.0))
    return smooth(config, camera, mount, log, path, state.segment_map, smoothing)


def _single(leaf: ArrayLike) -> Array:
    """The leaf as an array, float64 as float32."""
    leaf = jnp.asarray(leaf)
    return leaf.astype("float32") if leaf.dtype == "float64" else leaf
