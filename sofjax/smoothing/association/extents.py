"""Where along its line each segment lies, and so how far each line was seen."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sofjax.geometry.floor import floor_homography, segment_to_floor
from sofjax.geometry.lines import PolarLine, direction
from sofjax.geometry.se2 import SE2
from sofjax.smoothing.problem import Problem, corrected, foot_mount


@jax.jit
def places(
    problem: Problem, radius: Float[Array, ""] | float
) -> tuple[Float[Array, "n M 2"], Bool[Array, "n M"]]:
    """Places along its line, metres from the anchor, between which each segment lies.

    **Arguments:**
    - `radius`: R, metres: what is farther does not count.

    **Returns:** the places in order, and which segments show a line within range at all.
    """
    u, frames = problem.start, problem.keyframes
    mount = corrected(problem.mount, u.shared)

    def of_keyframe(
        pose: Array, endpoints: Array, index: Array, known: Array
    ) -> tuple[Array, Array]:
        T_world_nadir = SE2(pose[:2], pose[2]) @ mount.T_robot_nadir
        H_F = floor_homography(problem.camera, foot_mount(mount, pose), SE2.identity())

        def of_segment(ends: Array, k: Array) -> tuple[Array, Array]:
            line = u.line[k]
            on_floor, some = segment_to_floor(H_F, ends, jnp.asarray(radius, ends.dtype))
            # an off-floor line is seen magnified about the nadir
            anchor = jax.tree.map(lambda a: a[k], problem.anchor)
            local = (anchor.between(T_world_nadir)).apply(on_floor / line[2])
            return jnp.sort(local @ direction(PolarLine(line[0], line[1]))), some

        place, some = jax.vmap(of_segment)(endpoints, index)
        return place, some & known

    return jax.vmap(of_keyframe)(u.pose, frames.segments_image.endpoints, frames.line, frames.known)


@jax.jit
def reaches(
    problem: Problem, radius: Float[Array, ""] | float
) -> tuple[Float[Array, "K 2"], Bool[Array, "K"]]:
    """First and last place at which each line was seen, and whether it was."""
    place, some = places(problem, radius)
    K = problem.start.line.shape[0]
    index = jnp.where(some, problem.keyframes.line, K)
    low = jnp.full(K, jnp.inf).at[index].min(place[..., 0], mode="drop")
    high = jnp.full(K, -jnp.inf).at[index].max(place[..., 1], mode="drop")
    seen = low < high
    return jnp.where(seen[:, None], jnp.stack([low, high], axis=1), 0), seen
