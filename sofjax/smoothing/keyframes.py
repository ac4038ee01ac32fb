"""Which images of a drive are solved for, what was read between them, and the images between."""

import jax
import jax.numpy as jnp
import numpy as np

from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.observation import Observation
from sofjax.smoothing.problem import Keyframes

PAD = 64  # sizes are rounded up to multiples of it, so that drives share compiled programs


def choose(T_world_robot: SE2, distance: float, angle: float) -> np.ndarray:
    """Indices of the images that are `distance` metres or `angle` radians apart; first and last."""
    xy, yaw = np.asarray(T_world_robot.xy), np.asarray(T_world_robot.yaw)
    chosen = [0]
    for i in range(1, len(yaw)):
        j = chosen[-1]
        if np.hypot(*(xy[i] - xy[j])) >= distance or abs(yaw[i] - yaw[j]) >= angle:
            chosen.append(i)
    return np.array(chosen if chosen[-1] == len(yaw) - 1 else [*chosen, len(yaw) - 1])


def gather(log: Observation, index: np.ndarray) -> Keyframes:
    """The images of a log [T] at `index`, and what the odometer read from each to the next.

    **Returns:** keyframes padded by `padded`: what is added sees nothing and does not move. No
    segment is known yet.
    """
    start, left, right, distance = _dead_reckoned(log.motion)
    n = padded(len(index))
    filled = np.concatenate([index, np.full(n - len(index), index[-1])])
    before = np.concatenate([filled[:1], filled[:-1]])
    at = lambda i: jax.tree.map(lambda a: a[i], start)
    way = jnp.stack([total[filled] - total[before] for total in (distance, left, right)], axis=1)
    segments = jax.tree.map(lambda a: jnp.asarray(a)[filled], log.segments_image)
    real = jnp.arange(n) < len(index)
    segments = Segments(segments.endpoints.astype(way.dtype), segments.valid & real[:, None])
    none = jnp.zeros(segments.valid.shape, int)
    return Keyframes(segments, none, none > 0, at(before).between(at(filled)), way)


def padded(size: int) -> int:
    return -(-size // PAD) * PAD


@jax.jit
def _dead_reckoned(motion: SE2):
    """Poses by the odometer alone, and the totals of left turns, right turns and distance."""
    identity = SE2(jnp.zeros(2, motion.xy.dtype), jnp.zeros((), motion.yaw.dtype))
    step = lambda T, m: (T @ m, T @ m)
    _, poses = jax.lax.scan(step, identity, motion)
    forward, _, turn = jnp.moveaxis(motion.log(), -1, 0)
    return (
        poses,
        jnp.cumsum(jnp.maximum(turn, 0)),
        jnp.cumsum(jnp.minimum(turn, 0)),
        jnp.cumsum(jnp.abs(forward)),
    )


def carry(T_world_robot: SE2, index: np.ndarray, smoothed: SE2) -> SE2:
    """All poses [T], moved along with their keyframes [n]: the motion in between is kept, and the
    correction passes over from each keyframe to the next."""
    t = np.arange(len(T_world_robot.yaw))
    i = np.clip(np.searchsorted(index, t, side="right") - 1, 0, len(index) - 2)
    share = jnp.asarray((t - index[i]) / (index[i + 1] - index[i]))
    at = lambda T, k: jax.tree.map(lambda a: a[k], T)
    moved = lambda k: at(smoothed, k) @ at(T_world_robot, index[k]).between(T_world_robot)
    before, after = moved(i), moved(i + 1)
    mix = lambda a, b: a + share.reshape(-1, *[1] * (a.ndim - 1)) * (b - a)
    return jax.tree.map(mix, before, after)
