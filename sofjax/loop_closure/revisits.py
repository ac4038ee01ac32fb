"""Where in a drive to look for a place seen before, and the drive with its end put there."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sofjax.geometry.camera import Mount
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.loop_closure.distribute_error import distribute
from sofjax.loop_closure.place_recognition import Closing, ClosingConfig, find
from sofjax.segment_map import FinalMap, SegmentMap
from sofjax.smoothing import Path, Smoothed

WINDOW = 6.0  # metres of path whose new lines are matched together
AGO = 10.0  # metres of path after which a revisit is a loop
NEAR = 5.0  # metres about the later lines in which earlier ones count
EVERY = 2.0  # metres of path between the images that are asked


class TimedLines(eqx.Module):
    """A path, and lines that know when they were seen. Arrays on the host."""

    T_world_robot: SE2  # [T]
    sigma: Float[np.ndarray, "T 3"]  # standard deviations of x, y and yaw
    endpoints_world: Float[np.ndarray, "K 2 2"]
    first: np.ndarray  # [K] image of the first measurement ...
    last: np.ndarray  # ... and of the last; -1 for lines that are not to be used

    @property
    def travelled(self) -> np.ndarray:
        steps = np.diff(np.asarray(self.T_world_robot.xy, float), axis=0)
        return np.append(0.0, np.cumsum(np.hypot(*steps.T)))


def driven(path: Path, mount: Mount, segment_map: SegmentMap, final: FinalMap) -> TimedLines:
    """The path and lines of the filter; its drift is only known to grow with the distance."""
    T = jax.tree.map(lambda a: np.asarray(a, float), path.T_world_robot)
    nadirs = np.asarray(
        jax.jit(lambda T, xy: T.apply(xy))(path.T_world_robot, mount.T_robot_nadir.xy)
    )
    anchors = np.asarray(segment_map.anchor.xy)
    off = np.hypot(*np.moveaxis(anchors[:, None] - nadirs, -1, 0))
    off = off + np.abs(np.asarray(segment_map.anchor.yaw)[:, None] - T.yaw)
    use = np.asarray(final.is_floor)
    last = np.where(use, len(T.yaw) - 1 - np.asarray(segment_map.unseen), -1)
    ends = np.asarray(final.endpoints_world, float)
    drive = TimedLines(
        path.T_world_robot, np.zeros((len(T.yaw), 3)), ends, off.argmin(axis=1), last
    )
    way = drive.travelled[:, None]
    return eqx.tree_at(lambda d: d.sigma, drive, way * [0.005, 0.005, 0] + [0.05, 0.05, 0.02])


def solved(smoothed: Smoothed, final: FinalMap) -> TimedLines:
    """The path and lines of the smoother, with its covariances."""
    frames, index = smoothed.problem.keyframes, smoothed.index
    n, K = len(index), len(final.is_floor)
    frame, slot = np.nonzero(frames.known[:n])
    line = frames.line[frame, slot]
    first, last = np.full(K, n), np.full(K, -1)
    np.minimum.at(first, line, frame)
    np.maximum.at(last, line, frame)
    first, last = index[np.minimum(first, n - 1)], np.where(last >= 0, index[last], -1)
    at = np.clip(np.searchsorted(index, np.arange(len(smoothed.T_world_robot.yaw))), 0, n - 1)
    sigma = np.sqrt(np.einsum("nii->ni", smoothed.solution.pose_covariance)[:n, :3])[at]
    last = np.where(final.is_floor, last, -1)
    return TimedLines(
        smoothed.T_world_robot, np.maximum(sigma, [0.05, 0.05, 0.01]),
        np.asarray(final.endpoints_world), first, last,
    )  # fmt: skip


class Revisit(eqx.Module):
    """What was asked at an image, and what came of it."""

    image: int  # the place seen again
    since: int  # the image at which it was first seen
    closing: Closing
    lines: np.ndarray  # [P, 2] lines of the drive that are one: the later, the earlier


def revisits(
    config: ClosingConfig, drive: TimedLines, images: np.ndarray | None = None
) -> list[Revisit]:
    """Ask at each of some images, by default every few metres, whether the place was seen before.

    Lines that were seen both long ago and lately have been re-observed: they need no closing.
    """
    way = drive.travelled
    if images is None:
        images = np.searchsorted(way, np.arange(AGO, way[-1] + EVERY, EVERY))
        images = np.unique(np.minimum(images, len(way) - 1))
    found = []
    middle = drive.endpoints_world.mean(axis=1)
    for image in images:
        alive = drive.last >= 0
        new = alive & (way[drive.first] > way[image] - WINDOW) & (drive.first <= image)
        if not new.any():
            continue
        reach = NEAR + config.reach * drive.sigma[image, :2].max()
        near = np.hypot(*(middle - middle[new].mean(axis=0)).T) < reach
        old = alive & near & (way[drive.last] < way[image] - AGO)
        if min(new.sum(), old.sum()) < config.matched:
            continue
        i, j = np.flatnonzero(new), np.flatnonzero(old)
        closing = find(
            config, drive.endpoints_world[i], drive.endpoints_world[j], drive.sigma[image]
        )
        pairs = np.stack([i[closing.pairs[:, 0]], j[closing.pairs[:, 1]]], axis=1)
        since = drive.first[pairs[:, 1]].mean() if len(pairs) else drive.first[j].mean()
        found.append(Revisit(int(image), int(since), closing, pairs))
    return found


def closed(drive: TimedLines, revisit: Revisit) -> tuple[SE2, SE2]:
    """The path with the error of a revisit distributed back to where the place was first seen.

    **Returns:** the path [T], and the motion [T] of what was seen from each of its poses.
    """
    a, b = revisit.since, revisit.image
    part = lambda s: jax.tree.map(lambda v: jnp.asarray(v)[s], drive.T_world_robot)
    T = revisit.closing.T_correction
    way = jnp.asarray(drive.travelled[a : b + 1], part(slice(None)).yaw.dtype)
    moved, motion = distribute(part(slice(a, b + 1)), way, T)
    rest = part(slice(b + 1, None))
    still = jax.tree.map(lambda v: jnp.zeros_like(v[:a]), drive.T_world_robot)
    same = SE2(jnp.broadcast_to(T.xy, rest.xy.shape), jnp.broadcast_to(T.yaw, rest.yaw.shape))
    join = lambda *parts: jax.tree.map(lambda *v: jnp.concatenate(v), *parts)
    return join(part(slice(0, a)), moved, same @ rest), join(still, motion, same)


def moved_lines(drive: TimedLines, motion: SE2) -> Float[Array, "K 2 2"]:
    """The lines' end points, each moved with the pose from which it was first seen."""
    with_first = jax.tree.map(lambda v: v[drive.first], motion)
    return jax.vmap(lambda T, e: T.apply(e))(with_first, jnp.asarray(drive.endpoints_world))


def joined_map(smoothed: Smoothed, drive: TimedLines, motion: SE2, revisit: Revisit) -> SegmentMap:
    """The smoothed lines as a map to start from again; duplicates of the revisit are merged."""
    lines, K = smoothed.lines, len(smoothed.measurements)
    later = np.zeros(K, bool)
    later[revisit.lines[:, 0]] = True
    with_first = jax.tree.map(lambda v: v[drive.first], motion)
    dtype = with_first.yaw.dtype
    cast = lambda tree: jax.tree.map(lambda v: jnp.asarray(v, dtype), tree)
    apparent_scale = np.zeros((K, 3, 3))
    apparent_scale[:, [0, 1, 2], [0, 1, 2]] = 1e-6
    apparent_scale[:, 2, 2] = smoothed.solution.scale_sigma**2
    none = jnp.zeros(K, int)
    return SegmentMap(
        segments_world=Segments(moved_lines(drive, motion), jnp.asarray(lines.valid & ~later)),
        anchor=with_first @ cast(lines.anchor),
        line=cast(lines.line),
        covariance=cast(apparent_scale),
        updates=jnp.asarray(smoothed.measurements),
        resting=none,
        unseen=none,
        expected=none,
    )
