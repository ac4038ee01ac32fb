"""The final map of a solved drive, by the same rule as the filter's."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.se2 import SE2
from sofjax.segment_map import FinalMap, MapConfig, is_shown, middles_in_view
from sofjax.smoothing.smoother import Smoothed


def final_map(config: MapConfig, smoothed: Smoothed) -> FinalMap:
    """The lines that `is_shown` shows, with the height that each would have.

    Images are the keyframes here: those in which a line was measured, and those that should have
    shown it.
    """
    solution = smoothed.solution
    with jax.enable_x64(True):
        expected = _expected(config, smoothed)
        scale, sigma = jnp.asarray(solution.scale_free), jnp.asarray(solution.scale_sigma)
        updates = jnp.asarray(smoothed.measurements)
        found = FinalMap(
            endpoints_world=jnp.asarray(smoothed.endpoints_world),
            is_floor=smoothed.lines.valid & is_shown(config, scale, sigma, updates, expected),
            updates=updates,
            height=smoothed.mount.height * (1 - 1 / scale),
            height_sigma=smoothed.mount.height * sigma / scale**2,
        )
        return jax.device_get(found)


def _expected(config: MapConfig, smoothed: Smoothed) -> Int[Array, "K"]:
    """In how many keyframes the middle of each line was in view."""
    pose = jnp.asarray(smoothed.problem.start.pose)
    real = np.arange(len(pose)) < len(smoothed.index)
    ends, scale = jnp.asarray(smoothed.endpoints_world), jnp.asarray(smoothed.lines.line[:, 2:])
    camera = smoothed.problem.camera
    return _times_in_view(config, camera, smoothed.mount, ends, scale, pose, real)


@jax.jit
def _times_in_view(
    config: MapConfig,
    camera: Camera,
    mount: Mount,
    ends: Array,
    scale: Array,
    pose: Array,
    real: Array,
) -> Int[Array, "K"]:
    def add(total: Array, keyframe: tuple[Array, Array]) -> tuple[Array, None]:
        pose, real = keyframe
        T_world_robot = SE2(pose[:2], pose[2])
        seen = middles_in_view(config, camera, mount, ends, scale, T_world_robot)
        return total + (seen & real).astype(total.dtype), None

    return jax.lax.scan(add, jnp.zeros(len(ends), int), (pose, real))[0]
