"""The lines that are solved for, and which of them each segment of the keyframes shows."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax.geometry.angles import safe_norm
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.floor import floor_homography, may_be_upright, segment_to_floor
from sofjax.geometry.lines import PolarLine, cofactor, direction, line_point_distance, normal
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import overlap
from sofjax.segment_map import predict_measurement
from sofjax.smoothing.problem import Keyframes, Unknowns, corrected, foot_mount


class Lines(eqx.Module):
    """K lines and how far along them something was seen."""

    anchor: SE2  # [K] T_world_nadir in which each line is described
    line: Float[Array, "K 3"]  # (rho, theta, apparent scale) about the anchor
    reach: Float[Array, "K 2"]  # first and last place along the line, metres from the anchor
    off_floor: Bool[Array, "K"]  # not on the floor, or not known to be: the apparent scale is free
    valid: Bool[Array, "K"]
    span: Float[Array, "K 2"]  # metres of the way driven between which each may be seen
    undetermined: Bool[Array, "K"]  # whether it is off the floor is not known

    @property
    def endpoints_world(self) -> Float[Array, "K 2 2"]:
        """End points, at the lines' true places: the apparent scale magnifies rho."""
        polar = PolarLine(self.line[:, 0] / self.line[:, 2], self.line[:, 1])
        foot = normal(polar) * polar.rho[:, None]  # of the perpendicular from the anchor
        ends = foot[:, None] + self.reach[..., None] * direction(polar)[:, None]
        return jax.vmap(lambda T, e: T.apply(e))(self.anchor, ends)


def lines_of(
    anchor: SE2, line: Array, endpoints_world: Array, off_floor: Array, valid: Array
) -> Lines:
    """Lines whose reach is that of segments along them."""
    local = jax.vmap(lambda T, e: T.inverse().apply(e))(anchor, endpoints_world)
    along = jnp.einsum("kij,kj->ki", local, direction(PolarLine(line[:, 0], line[:, 1])))
    always = jnp.broadcast_to(jnp.array([-jnp.inf, jnp.inf], line.dtype), along.shape)
    known = jnp.zeros_like(valid)
    return Lines(anchor, line, jnp.sort(along, axis=1), off_floor, valid, always, known)


NEAREST = 256  # lines about a keyframe that its segments may show


class Seeing(eqx.Module):
    """Gates by which a segment is associated with a line."""

    gate: float = 3.0  # pixels that an end may be off its line
    angle: float = 0.15  # radians between a segment and its line in the image
    join_gap: float = 0.1  # camera heights that a segment may lie beyond what was seen of its line


def associate(
    seeing: Seeing, max_depth: Float[Array, ""] | float, upright_gate: Float[Array, ""] | float,
    camera: Camera, mount: Mount, lines: Lines, unknowns: Unknowns, frames: Keyframes,
) -> tuple[Int[Array, "n M"], Bool[Array, "n M"]]:  # fmt: skip
    """For each segment of each keyframe the line that lies nearest to both of its ends, in pixels.

    **Arguments:**
    - `max_depth`: metres; what is farther is not used.
    - `upright_gate`: pixels, of `may_be_upright`; what may be shows no line.
    - `unknowns`: their poses and jitters, about `mount`.

    **Returns:** the line's index, and whether there is one within the gates.
    """
    mount = corrected(mount, unknowns.shared)
    K, ends_world = lines.valid.shape[0], lines.endpoints_world

    def of_keyframe(each: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        pose, endpoints, valid, driven = each
        T_world_nadir = SE2(pose[:2], pose[2]) @ mount.T_robot_nadir
        H_F = floor_homography(camera, foot_mount(mount, pose), SE2.identity())
        seen, _ = jax.vmap(predict_measurement, in_axes=(0, 0, None))(
            lines.line, lines.anchor, T_world_nadir
        )
        apparent = T_world_nadir.inverse().apply(ends_world) * seen[:, 2, None, None]
        there = lines.valid & (lines.span[:, 0] <= driven) & (driven <= lines.span[:, 1])
        far = jnp.where(there, jax.vmap(_from_origin)(apparent), jnp.inf)
        near = jax.lax.top_k(-far, min(K, NEAREST))[1]
        seen, apparent, there = seen[near], apparent[near], there[near]
        n = normal(PolarLine(seen[:, 0], seen[:, 1]))
        l = jnp.concatenate([n, -seen[:, :1]], axis=1) @ cofactor(H_F).T
        distance = jax.vmap(jax.vmap(line_point_distance, in_axes=(0, None)), in_axes=(None, 0))
        first, second = distance(l, endpoints[:, 0]), distance(l, endpoints[:, 1])
        length = jnp.linalg.norm(endpoints[:, 1] - endpoints[:, 0], axis=1)[:, None]

        on_floor, some = jax.vmap(segment_to_floor, in_axes=(None, 0, None))(
            H_F, endpoints, jnp.asarray(max_depth, pose.dtype)
        )
        shared = jax.vmap(jax.vmap(overlap, in_axes=(0, None)), in_axes=(None, 0))
        upright = jax.vmap(may_be_upright, in_axes=(None, 0, None))(
            H_F[:, 2], endpoints, jnp.asarray(upright_gate, pose.dtype)
        )
        possible = (
            (jnp.maximum(jnp.abs(first), jnp.abs(second)) < seeing.gate)
            & (jnp.abs(first - second) < seeing.angle * length)
            & (shared(apparent, on_floor) > -seeing.join_gap)
            & there
            & (valid & some & ~upright)[:, None]
        )
        off = jnp.where(possible, first**2 + second**2, jnp.inf)
        return near[off.argmin(axis=1)], possible.any(axis=1)

    segments = frames.segments_image
    each = (unknowns.pose, segments.endpoints, segments.valid, frames.driven)
    return jax.lax.map(of_keyframe, each, batch_size=8)


def _from_origin(ends: Float[Array, "2 2"]) -> Float[Array, ""]:
    """Distance of a segment."""
    d = ends[1] - ends[0]
    share = jnp.clip(-ends[0] @ d / jnp.maximum(d @ d, 1e-12), 0, 1)
    return safe_norm(ends[0] + share * d)
