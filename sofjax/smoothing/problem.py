"""What is solved for, what is known, and the residuals between them."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax.geometry.angles import safe_sqrt
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.floor import floor_homography
from sofjax.geometry.lines import cofactor, line_point_distance
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.motion import MotionModel, odometer_sigma, prior_bias, read_twist
from sofjax.segment_map import predict_measurement

POSE, LINE, SHARED = 5, 3, 8  # unknowns of a keyframe, of a line, and of the whole drive


class Keyframes(eqx.Module):
    """What was seen and read at n keyframes."""

    segments_image: Segments  # [n, M] pixels
    line: Int[Array, "n M"]  # the map line that each segment shows
    known: Bool[Array, "n M"]  # whether it shows any
    motion: SE2  # [n] odometer since the keyframe before; the first is not used
    way: Float[Array, "n 3"]  # metres driven, radians turned left and (negative) right, as read
    unknown: Float[Array, "n 3"] | None = None  # variance of what the odometer did not tell of it

    @property
    def driven(self) -> Float[Array, "n"]:
        """Metres since the first."""
        return jnp.cumsum(self.way[:, 0])


class Unknowns(eqx.Module):
    """What is solved for."""

    pose: Float[Array, "n 5"]  # x, y, yaw in the world, and the jitter (pitch, roll) of the moment
    line: Float[Array, "K 3"]  # (rho, theta, apparent scale) about each line's anchor
    shared: Float[Array, "8"]  # corrections of height, pitch, roll, yaw; the odometer's errors b


class Priors(eqx.Module):
    """Standard deviations of what is known beforehand."""

    pixel_sigma: float = 0.5  # pixels
    loss_scale: float = 3.0  # residuals, in sigmas, from which they count linearly only
    tilt_sigma: float = 0.001  # radians
    mount_sigma: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)  # height, pitch, roll, yaw
    scale_sigma: float = 0.3  # of a line that is not on the floor


LEAST = 1e-3  # metres or radians: keyframes have moved by much more
FIXED = 1e-7  # the standard deviation of what is not free


class Problem(eqx.Module):
    """Everything that the residuals need and that is not solved for."""

    camera: Camera
    mount: Mount
    motion_model: MotionModel
    priors: Priors
    keyframes: Keyframes
    anchor: SE2  # [K] T_world_nadir in which each line is described
    off_floor: Bool[Array, "K"]  # lines whose apparent scale is free
    start: Unknowns  # the first pose stays; lines that nobody sees stay


class Residuals(eqx.Module):
    """In standard deviations."""

    pixels: Float[Array, "n M 2"]
    odometer: Float[Array, "n 3"]  # of the motion from the keyframe before; the first: the prior
    tilt: Float[Array, "n 2"]
    line: Float[Array, "K 3"]
    shared: Float[Array, "8"]


def corrected(mount: Mount, shared: Float[Array, "8"]) -> Mount:
    """The mount with the corrections that were solved for."""
    height, pitch, roll, yaw = shared[:4]
    return Mount(
        mount.x,
        mount.y,
        mount.height + height,
        mount.pitch + pitch,
        mount.roll + roll,
        mount.yaw + yaw,
    )


def foot_mount(mount: Mount, pose: Float[Array, "5"]) -> Mount:
    """The mount about the nadir, with the jitter of a keyframe."""
    zero = jnp.zeros_like(mount.height)
    return Mount(zero, zero, mount.height, mount.pitch + pose[3], mount.roll + pose[4], mount.yaw)


def pixel_residual(
    problem: Problem,
    pose: Float[Array, "5"],
    line: Float[Array, "3"],
    shared: Float[Array, "8"],
    anchor: SE2,
    segment_image: Float[Array, "2 2"],
) -> Float[Array, "2"]:
    """Distances of a segment's end points from its line, l = H_F^-T L, in pixels."""
    mount = corrected(problem.mount, shared)
    T_world_nadir = SE2(pose[:2], pose[2]) @ mount.T_robot_nadir
    seen, _ = predict_measurement(line, anchor, T_world_nadir)
    L = jnp.stack([-jnp.sin(seen[1]), jnp.cos(seen[1]), -seen[0]])
    H_F = floor_homography(problem.camera, foot_mount(mount, pose), SE2.identity())
    l = cofactor(H_F) @ L
    return jax.vmap(line_point_distance, in_axes=(None, 0))(l, segment_image)


def robust(r: Float[Array, "d"], scale: Float[Array, ""] | float) -> Float[Array, "d"]:
    """Residuals whose square grows as |r| beyond `scale`, smooth everywhere (pseudo-Huber)."""
    return r * jnp.sqrt(2 / (1 + jnp.sqrt(1 + jnp.sum(r**2) / scale**2)))


def odometer_residual(
    problem: Problem, before: Float[Array, "5"], after: Float[Array, "5"],
    shared: Float[Array, "8"], motion: SE2, way: Float[Array, "3"],
    unknown: Float[Array, "3"] | None = None,
) -> Float[Array, "3"]:  # fmt: skip
    """Motion against reading, (forward, sideways, turn), by the motion model's noise."""
    moved = SE2(before[:2], before[2]).between(SE2(after[:2], after[2])).log()
    sigma = odometer_sigma(problem.motion_model, way, LEAST, unknown)
    return (moved - read_twist(motion, way, shared[4:])) / sigma


def distances(unknowns: Unknowns, problem: Problem) -> Float[Array, "n M 2"]:
    """Of the ends of each segment from the line that it shows, pixels; zero if it shows none."""
    k = problem.keyframes

    def of_keyframe(pose: Array, endpoints: Array, index: Array, known: Array) -> Array:
        of_segment = lambda segment, j: pixel_residual(
            problem, pose, unknowns.line[j], unknowns.shared,
            jax.tree.map(lambda a: a[j], problem.anchor), segment,
        )  # fmt: skip
        return jnp.where(known[:, None], jax.vmap(of_segment)(endpoints, index), 0)

    return jax.vmap(of_keyframe)(unknowns.pose, k.segments_image.endpoints, k.line, k.known)


def rms_distance(problem: Problem) -> Float[Array, ""]:
    """Root mean square of the distances at the start, pixels; zero where nothing is known."""
    known = 2 * problem.keyframes.known.sum()
    total = jnp.sum(distances(problem.start, problem) ** 2)
    return safe_sqrt(total / jnp.maximum(known, 1).astype(total.dtype))


def residuals(unknowns: Unknowns, problem: Problem) -> Residuals:
    """All of them, about the estimate."""
    k, priors = problem.keyframes, problem.priors

    r = distances(unknowns, problem) / priors.pixel_sigma
    pixels = jax.vmap(jax.vmap(robust, in_axes=(0, None)), in_axes=(0, None))(r, priors.loss_scale)
    read = jax.tree.map(lambda a: a[1:], (k.motion, k.way, k.unknown))
    odometer = jax.vmap(odometer_residual, in_axes=(None, 0, 0, None, 0, 0, 0))(
        problem, unknowns.pose[:-1], unknowns.pose[1:], unknowns.shared, *read
    )
    first = (unknowns.pose[:1, :3] - problem.start.pose[:1, :3]) / 1e-4
    scale_sigma = jnp.where(problem.off_floor, priors.scale_sigma, FIXED)
    loose = jnp.full_like(scale_sigma, 10.0)  # keeps a line that nobody sees where it is
    line_sigma = jnp.stack([loose, loose, scale_sigma], axis=1)
    centre = problem.start.line.at[:, 2].set(1)
    bias = prior_bias(problem.motion_model)
    bias_sigma = jnp.sqrt(jnp.diag(bias.covariance))
    shared_sigma = jnp.concatenate([jnp.asarray(priors.mount_sigma), bias_sigma])
    return Residuals(
        pixels=pixels,
        odometer=jnp.concatenate([first, odometer]),
        tilt=unknowns.pose[:, 3:] / jnp.maximum(priors.tilt_sigma, FIXED),
        line=(unknowns.line - centre) / line_sigma,
        shared=unknowns.shared.at[4:].add(-bias.mean) / jnp.maximum(shared_sigma, FIXED),
    )
