"""Which images of a drive are solved for, what was read between them, and the images between."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from sofjax.extraction.observation import Observation
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.motion import way_of
from sofjax.smoothing.problem import Keyframes

PAD = 64  # sizes are rounded up from here on, so that drives share compiled programs


def choose(T_world_robot: SE2, distance: float, angle: float) -> np.ndarray:
    """Indices of the images that are `distance` metres or `angle` radians apart; first and last."""
    xy, yaw = np.asarray(T_world_robot.xy), np.asarray(T_world_robot.yaw)
    chosen = [0]
    for i in range(1, len(yaw)):
        j = chosen[-1]
        if np.hypot(*(xy[i] - xy[j])) >= distance or abs(yaw[i] - yaw[j]) >= angle:
            chosen.append(i)
    return np.array(chosen if chosen[-1] == len(yaw) - 1 else [*chosen, len(yaw) - 1])


def gather(log: Observation, index: np.ndarray, room: int = PAD) -> Keyframes:
    """The images of a log [T] at `index`, and what the odometer read from each to the next.

    **Returns:** keyframes padded by `filled`: what is added sees nothing and does not move. No
    segment is known yet.
    """
    return _gather(log, filled(index, padded(len(index), room)), len(index))


def padded(size: int, least: int = PAD) -> int:
    """To three or four quarters of a power of two times `least`; large sizes to its eighths."""
    room = least
    while room < size:
        room *= 2
    if room == least:
        return room
    step = room // (4 if room <= 1024 else 8)
    return -(-size // step) * step


def narrowed(frames: Keyframes, width: int) -> Keyframes:
    """The segments that show a line come first, and only `width` of them are kept."""
    order = jnp.argsort(~frames.known, axis=1)[:, :width]
    take = lambda a: jnp.take_along_axis(a, order, axis=1)
    segments = frames.segments_image
    ends = jnp.take_along_axis(segments.endpoints, order[..., None, None], axis=1)
    seen = Segments(ends, take(segments.valid))
    read = frames.motion, frames.way, frames.unknown
    return Keyframes(seen, take(frames.line), take(frames.known), *read)


def filled(index: np.ndarray, size: int) -> np.ndarray:
    """The indices, the last one repeated up to a size."""
    return np.append(index, np.full(size - len(index), index[-1]))


@jax.jit
def _gather(log: Observation, index: Array | np.ndarray, count: ArrayLike) -> Keyframes:
    motion = log.motion
    identity = SE2(jnp.zeros(2, motion.xy.dtype), jnp.zeros((), motion.yaw.dtype))
    _, poses = jax.lax.scan(lambda T, m: (T @ m, T @ m), identity, motion)
    totals = jnp.cumsum(way_of(motion), axis=0)

    before = jnp.append(index[:1], index[:-1])
    at = lambda i: jax.tree.map(lambda a: a[i], poses)
    segments = jax.tree.map(lambda a: a[index], log.segments_image)
    real = jnp.arange(index.shape[0]) < count
    segments = Segments(segments.endpoints, segments.valid & real[:, None])
    none = jnp.zeros(segments.valid.shape, int)
    since = lambda totals: totals[index] - totals[before]
    unknown = None
    if log.motion_sigma is not None:
        unknown = since(jnp.cumsum(log.motion_sigma**2, axis=0))
    moved = at(before).between(at(index))
    return Keyframes(segments, none, none > 0, moved, since(totals), unknown)


def carry(T_world_robot: SE2, index: np.ndarray, smoothed: SE2) -> SE2:
    """All poses [T], moved along with their keyframes: the motion in between is kept, and the
    correction passes over from each keyframe to the next.

    **Arguments:**
    - `index`: the keyframes' images, two at least.
    - `smoothed`: poses of the keyframes, padded or not.
    """
    at = filled(index, len(smoothed.yaw))
    return _carry(T_world_robot, at, len(index), smoothed)


@jax.jit
def _carry(T_world_robot: SE2, index: Array | np.ndarray, count: ArrayLike, smoothed: SE2) -> SE2:
    t = jnp.arange(T_world_robot.yaw.shape[0])
    i = jnp.clip(jnp.searchsorted(index, t, side="right") - 1, 0, count - 2)
    width = jnp.maximum(index[i + 1] - index[i], 1).astype(T_world_robot.yaw.dtype)
    share = (t - index[i]).astype(width.dtype) / width
    at = lambda T, k: jax.tree.map(lambda a: a[k], T)
    moved = lambda k: at(smoothed, k) @ at(T_world_robot, index[k]).between(T_world_robot)
    before, after = moved(i), moved(i + 1)
    mix = lambda a, b: a + share.reshape(-1, *[1] * (a.ndim - 1)) * (b - a)
    return jax.tree.map(mix, before, after)
