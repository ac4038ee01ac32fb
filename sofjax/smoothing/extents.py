"""Where along its line each segment lies, and which parts of a line were seen often enough."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sofjax.geometry.floor import floor_homography, floor_to_image, segment_to_floor
from sofjax.geometry.lines import PolarLine, direction
from sofjax.geometry.se2 import SE2
from sofjax.smoothing.lines import Lines, foot_mount
from sofjax.smoothing.problem import Problem, corrected

SPACING = 0.05  # metres between the places of a line that are asked for
RANGE = 5.0  # R, metres: what is farther does not extend a line


@jax.jit
def places(problem: Problem) -> tuple[Float[Array, "n M 2"], Bool[Array, "n M"]]:
    """Places along its line, metres from the anchor, between which each segment lies.

    **Returns:** the places in order, and which segments show a line within range at all.
    """
    u, frames = problem.start, problem.keyframes
    mount = corrected(problem.mount, u.shared)

    def of_keyframe(pose, endpoints, index, known):
        T_world_foot = SE2(pose[:2], pose[2]) @ mount.T_robot_foot
        H_F = floor_homography(problem.camera, foot_mount(mount, pose), SE2.identity())

        def of_segment(ends, k):
            line = u.line[k]
            on_floor, some = segment_to_floor(H_F, ends, jnp.asarray(RANGE, ends.dtype))
            # a raised line is seen magnified about the foot
            anchor = jax.tree.map(lambda a: a[k], problem.anchor)
            local = (anchor.between(T_world_foot)).apply(on_floor / line[2])
            return jnp.sort(local @ direction(PolarLine(line[0], line[1]))), some

        place, some = jax.vmap(of_segment)(endpoints, index)
        return place, some & known

    return jax.vmap(of_keyframe)(u.pose, frames.segments_image.endpoints, frames.line, frames.known)


@jax.jit
def reaches(problem: Problem) -> tuple[Float[Array, "K 2"], Bool[Array, "K"]]:
    """First and last place at which each line was seen, and whether it was."""
    place, some = places(problem)
    K = problem.start.line.shape[0]
    index = jnp.where(some, problem.keyframes.line, K)
    low = jnp.full(K, jnp.inf).at[index].min(place[..., 0], mode="drop")
    high = jnp.full(K, -jnp.inf).at[index].max(place[..., 1], mode="drop")
    seen = low < high
    return jnp.where(seen[:, None], jnp.stack([low, high], axis=1), 0), seen


def pieces(
    problem: Problem, lines: Lines, least: int, share: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The parts of the lines that were seen in `least` keyframes, and in a share of those that
    should have shown them.

    Places are asked for one by one, so that a line that runs on beyond what was seen of it, or
    bridges what is not there, loses that part.

    **Returns:** the parts' end points [P, 2, 2] in the world, the line of each [P], and in how many
    keyframes it was seen on the mean [P].
    """
    place, some = jax.device_get(places(problem))
    index = np.where(some, problem.keyframes.line, -1)
    ends, owner, seen = [], [], []
    for k in np.flatnonzero(np.asarray(lines.valid)):
        frame, slot = np.nonzero(index == k)
        if len(frame) < least:
            continue
        low, high = place[frame, slot].T
        at = np.arange(low.min() + SPACING / 2, high.max(), SPACING)
        covered = (low <= at[:, None] + SPACING / 2) & (high >= at[:, None] - SPACING / 2)
        count = np.zeros((len(at), frame.max() + 1), bool)
        for i in np.unique(frame):
            count[:, i] = covered[:, frame == i].any(axis=1)
        count = count.sum(axis=1)
        anchor = jax.tree.map(lambda a, k=k: a[k], lines.anchor)
        points = _points(anchor, lines.line[k], at)
        keep = (count >= least) & (count >= share * in_sight(problem, points))
        for run in np.split(np.arange(len(at)), np.flatnonzero(np.diff(keep)) + 1):
            if len(run) and keep[run[0]]:
                reach = at[run[[0, -1]]] + np.array([-0.5, 0.5]) * SPACING
                reach = np.clip(reach, low.min(), high.max())
                ends.append(_points(anchor, lines.line[k], reach))
                owner.append(k)
                seen.append(count[run].mean())
    return np.reshape(ends, (-1, 2, 2)), np.array(owner, int), np.array(seen)


def _points(anchor: SE2, line: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Places along a line in the world."""
    rho, theta = line[0] / line[2], line[1]
    n, d = np.array([-np.sin(theta), np.cos(theta)]), np.array([np.cos(theta), np.sin(theta)])
    c, s = np.cos(anchor.yaw), np.sin(anchor.yaw)
    local = rho * n + at[:, None] * d
    return local @ np.array([[c, s], [-s, c]]) + anchor.xy


def in_sight(problem: Problem, points_world: np.ndarray) -> np.ndarray:
    """In how many keyframes each point [P] of the floor lies in the image and within range."""
    P = -(-len(points_world) // 256) * 256
    points = np.zeros((P, 2))
    points[: len(points_world)] = points_world
    return np.asarray(_in_sight(problem, jnp.asarray(points)))[: len(points_world)]


@jax.jit
def _in_sight(problem, points):
    u, camera = problem.start, problem.camera
    mount = corrected(problem.mount, u.shared)
    size = jnp.array([camera.width, camera.height], points.dtype)
    looking = problem.keyframes.segments_image.valid.any(axis=1)

    def of_keyframe(pose):
        T_world_foot = SE2(pose[:2], pose[2]) @ mount.T_robot_foot
        H_F = floor_homography(problem.camera, foot_mount(mount, pose), SE2.identity())
        local = T_world_foot.inverse().apply(points)
        x, ahead = jax.vmap(floor_to_image, in_axes=(None, 0))(H_F, local)
        inside = (x >= 0).all(axis=1) & (x < size).all(axis=1)
        return inside & ahead & (jnp.sum(local**2, axis=1) < RANGE**2)

    return (jax.vmap(of_keyframe)(u.pose) & looking[:, None]).sum(axis=0)
