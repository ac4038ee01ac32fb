"""Bundle adjustment of the last keyframes and their lines: what is shown, errors and one step.

Gauss-Newton over the keyframes' poses and attitude jitters and the odometer's errors, the lines
eliminated (Triggs et al., Bundle adjustment, a modern synthesis, 2000, section 6).
"""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve, solve_triangular
from jaxtyping import Array, Bool, Float, Int

from sofjax.geometry.lines import (
    PolarLine,
    alignment,
    direction,
    normal,
    polar_difference,
    rename_covariance,
)
from sofjax.geometry.matrices import inverse_2x2
from sofjax.geometry.se2 import SE2
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.likelihood.tracking import mahalanobis
from sofjax.motion import OdometerBias, odometer_sigma, read_twist
from sofjax.segment_map import MapConfig, SegmentMap, candidate_associations, predict_measurement
from sofjax.slam.config import SlamConfig
from sofjax.slam.keyframes import Keyframe, Known

POSE, BIAS = 5, 4  # unknowns: a keyframe's (x, y, yaw) and jitter (pitch, roll); errors of odometer
GATE = 9.0  # squared error up to which a segment may show a line, ...
HALF = 16.0  # at which it counts half (Cauchy)
LEAST = 3e-4  # metres, radians: no reading of the odometer is better


Tree = TypeVar("Tree")


def where_each(condition: Bool[Array, "n"], a: Tree, b: Tree) -> Tree:
    """`jnp.where` of two trees by the first axis of all leaves."""
    one = lambda a, b: jnp.where(condition.reshape(-1, *[1] * (a.ndim - 1)), a, b)
    return jax.tree.map(one, a, b)


class Shown(eqx.Module):
    """Which line each segment of an image shows."""

    line: Int[Array, "*batch M"]  # of the J lines
    paired: Bool[Array, "*batch M"]
    polar: Float[Array, "*batch M 2"]  # (rho, theta) by the line's name, before the jitter
    precision: Float[Array, "*batch M 2 2"]  # zero where none is shown
    by_jitter: Float[Array, "*batch M 2 2"]  # what the attitude jitter adds to it


def look(
    map_config: MapConfig,
    sensor: SensorModel,
    lines: SegmentMap,
    frame: Keyframe,
    T_robot_nadir: SE2,
) -> Shown:
    """Which line each segment of a keyframe shows, seen from its present pose."""
    measurements, T_world_nadir = frame.measurements, frame.T_world_robot @ T_robot_nadir
    level = eqx.tree_at(lambda s: s.line, measurements, measurements.without_jitter(frame.jitter))
    _, at, error = candidate_associations(map_config, sensor, lines, level, T_world_nadir, most=1)
    at, paired = at[:, 0], measurements.valid & (error < GATE)
    line_of, anchor_of = jax.tree.map(lambda a: a[at], (lines.line, lines.anchor))
    predicted = jax.vmap(predict_measurement, in_axes=(0, 0, None))
    expected, _ = predicted(line_of, anchor_of, T_world_nadir)
    line = PolarLine(expected[:, 0], expected[:, 1])
    side = alignment(line, measurements.line)
    covariance = rename_covariance(measurements.covariance, side)
    precision = inverse_2x2(jnp.where(paired[:, None, None], covariance, jnp.eye(2)))
    return Shown(
        at, paired,
        polar=expected[:, :2] - polar_difference(line, measurements.line),
        precision=jnp.where(paired[:, None, None], precision, 0),
        by_jitter=measurements.by_jitter
        * jnp.stack([side, jnp.ones_like(side)], axis=1)[..., None],
    )  # fmt: skip


class Linear(eqx.Module):
    """Errors of the measurements of some keyframes, and how they fall with what is solved for."""

    line: Int[Array, "F M"]
    paired: Bool[Array, "F M"]
    error: Float[Array, "F M 2"]
    by_pose: Float[Array, "F M 2 5"]
    by_line: Float[Array, "F M 2 3"]
    weight: Float[Array, "F M 2 2"]
    lines: int = eqx.field(static=True)  # J


def linearise(
    shown: Shown, frames: Keyframe, anchor: SE2, line: Float[Array, "J 3"], T_robot_nadir: SE2
) -> Linear:
    """The measurements' errors at poses and lines, with their Jacobians and robust weights."""

    def of_measurement(T: SE2, line: Array, anchor: SE2) -> tuple[Array, ...]:
        seen = lambda move, line: predict_measurement(
            line, anchor, T @ SE2.exp(move) @ T_robot_nadir
        )[0][:2]
        still = jnp.zeros(3)
        return seen(still, line), *jax.jacfwd(seen, argnums=(0, 1))(still, line)

    of_each = jax.tree.map(lambda a: a[shown.line], (line, anchor))
    of_image = jax.vmap(of_measurement, in_axes=(None, 0, 0))
    expected, by_motion, by_line = jax.vmap(of_image)(frames.T_world_robot, *of_each)
    error = shown.polar - expected - jnp.einsum("fmij,fj->fmi", shown.by_jitter, frames.jitter)
    squared = jnp.where(shown.paired, mahalanobis(error, shown.precision), 0)
    return Linear(
        shown.line, shown.paired, error,
        by_pose=jnp.concatenate([by_motion, shown.by_jitter], axis=-1),
        by_line=by_line,
        weight=shown.precision / (1 + squared / HALF)[..., None, None],
        lines=len(line),
    )  # fmt: skip


def by_line(linear: Linear, a: Array) -> Array:
    """Sums [J, ...] over the measurements of each line."""
    return jax.ops.segment_sum(a.reshape(-1, *a.shape[2:]), linear.line.reshape(-1), linear.lines)


def _of_lines(known: Known, about: Float[Array, "J 3"], linear: Linear) -> tuple[Array, Array]:
    """Normal equations [J, 3, 3] and [J, 3] of the lines' steps from `about`, given the poses."""
    JW = jnp.einsum("fmia,fmij->fmaj", linear.by_line, linear.weight)
    gradient = by_line(linear, jnp.einsum("fmaj,fmj->fma", JW, linear.error))
    prior = jnp.einsum("kab,kb->ka", known.information, known.line - about)
    return known.information + by_line(linear, JW @ linear.by_line), gradient + prior


def learned(known: Known, about: Float[Array, "J 3"], linear: Linear) -> Known:
    """The lines' information with that of further measurements, linearised about `about`."""
    information, gradient = _of_lines(known, about, linear)
    return Known(about + jnp.linalg.solve(information, gradient[..., None])[..., 0], information)


def odometry_residuals(
    config: SlamConfig,
    frames: Keyframe,
    bias: Float[Array, "4"],
    prior: OdometerBias,
    x: Float[Array, "n"],
) -> Float[Array, "r"]:
    """Whitened residuals of readings, jitters and the odometer's errors, after a step x."""
    pose, b = x[:-BIAS].reshape(-1, POSE), bias + x[-BIAS:]
    T = frames.T_world_robot @ SE2.exp(pose[:, :3])
    before, after, read = (
        jax.tree.map(lambda a, s=s: a[s], t)
        for t, s in ((T, slice(-1)), (T, slice(1, None)), (frames, slice(1, None)))
    )
    twist = jax.vmap(read_twist, in_axes=(0, 0, None))(read.motion, read.way, b)
    sigma = jax.vmap(odometer_sigma, in_axes=(None, 0, None, 0))(
        config.motion, read.way, LEAST, read.unread
    )
    off = (before.between(after).log() - twist) / sigma * read.trust[:, None]
    jitter = (frames.jitter + pose[:, 3:]) / jnp.maximum(config.sensor.tilt_sigma, 1e-7)
    root = jnp.linalg.cholesky(prior.covariance + 1e-10 * jnp.eye(BIAS))
    whitened_bias = solve_triangular(root, b - prior.mean, lower=True)
    return jnp.concatenate([off.reshape(-1), jitter.reshape(-1), whitened_bias])


def gauss_newton(
    linear: Linear,
    known: Known,
    floor: Float[Array, "J"],
    odometry: Callable[[Array], Array],
    held: Bool[Array, "n"],
    line: Float[Array, "J 3"],
) -> tuple[Float[Array, "n"], Float[Array, "J 3"]]:
    """One step of Gauss-Newton, the lines eliminated (Triggs et al., 2000, section 6).

    **Arguments:**
    - `floor`: information that holds each line's apparent scale at 1.
    - `odometry`: residuals after a step of poses and the odometer's errors.
    - `held`: unknowns that stay as they are.

    **Returns:** the step of the poses and the odometer's errors, and the lines after it.
    """
    W, n = len(linear.error), held.shape[0]
    JpW = jnp.einsum("wmia,wmij->wmaj", linear.by_pose, linear.weight)
    JlW = jnp.einsum("wmia,wmij->wmaj", linear.by_line, linear.weight)
    zero = jnp.zeros(n)
    r, J = odometry(zero), jax.jacfwd(odometry)(zero)
    of_pose = jnp.einsum("wmaj,wmjb,wv->wavb", JpW, linear.by_pose, jnp.eye(W))
    A = J.T @ J + jnp.pad(of_pose.reshape(W * POSE, W * POSE), (0, BIAS))
    b = jnp.pad(jnp.einsum("wmaj,wmj->wa", JpW, linear.error).reshape(-1), (0, BIAS)) - J.T @ r

    # of the lines, and between those and the poses
    free, c = _of_lines(known, line, linear)
    C, c = free.at[:, 2, 2].add(floor), c.at[:, 2].add(floor * (1 - line[:, 2]))
    frame = jnp.broadcast_to(jnp.arange(W)[:, None], linear.line.shape)
    each = jnp.zeros((linear.lines, W, 3, POSE)).at[linear.line, frame].add(JlW @ linear.by_pose)
    E = jnp.pad(jnp.swapaxes(each, 1, 2).reshape(-1, 3, W * POSE), [(0, 0), (0, 0), (0, BIAS)])

    S = jnp.linalg.solve(C, jnp.concatenate([E, c[..., None]], axis=2))
    reduced = A - jnp.einsum("kax,kay->xy", E, S[..., :-1])
    b = b - jnp.einsum("kax,ka->x", E, S[..., -1])
    reduced = jnp.where(held[:, None] | held, jnp.eye(n), reduced)
    b = jnp.where(held, 0, b)
    scale = jnp.diag(reduced) ** -0.5  # metres and radians
    x = scale * cho_solve(cho_factor(reduced * scale[:, None] * scale), scale * b)
    return x, line + S[..., -1] - S[..., :-1] @ x


def moved(frames: Keyframe, step: Float[Array, "n"]) -> Keyframe:
    """The keyframes after a step of their poses and jitters."""
    step = step.reshape(-1, POSE)
    T = frames.T_world_robot @ SE2.exp(step[:, :3])
    return eqx.tree_at(
        lambda f: (f.T_world_robot, f.jitter), frames, (T, frames.jitter + step[:, 3:])
    )


def laid(lines: SegmentMap, line: Float[Array, "J 3"]) -> Float[Array, "J 2 2"]:
    """The segments where their lines are now, in the world."""
    polar = PolarLine(line[:, 0] / line[:, 2], line[:, 1])
    ends = jax.vmap(lambda T, e: T.inverse().apply(e))(lines.anchor, lines.segments_world.endpoints)
    d = direction(polar)[:, None]
    along = jnp.sum(ends * d, axis=2, keepdims=True)
    ends = polar.rho[:, None, None] * normal(polar)[:, None] + along * d
    return jax.vmap(SE2.apply)(lines.anchor, ends)
