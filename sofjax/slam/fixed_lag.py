"""Smoothing while driving: the last keyframes and the lines that they show, solved for together.

The filter puts a line where it is seen from the pose of the moment, and takes no pose back. Here
the last W keyframes stay open: at each new one their poses, their jitters, the odometer's errors
and the lines are solved for by Gauss-Newton, the lines eliminated (Triggs et al., Bundle
adjustment, a modern synthesis, 2000, section 6), and which line each segment shows is told anew.
What the oldest saw passes over into what is known of the lines, as if the pose that it leaves with
were exact.
"""

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
from sofjax.likelihood.measurements import Measurements, SensorModel
from sofjax.likelihood.tracking import mahalanobis
from sofjax.motion import MotionModel, OdometerBias, odometer_sigma, read_twist, way_of
from sofjax.segment_map import (
    MapConfig,
    SegmentMap,
    candidate_associations,
    is_off_floor,
    nearby,
    predict_measurement,
)

POSE, BIAS = 5, 4  # unknowns: a keyframe's (x, y, yaw) and jitter (pitch, roll); errors of odometer
ROUNDS = 2  # of Gauss-Newton
GATE = 9.0  # squared error up to which a segment may show a line, ...
HALF = 16.0  # at which it counts half (Cauchy), ...
SLIPPED = 9.0  # and of the odometer, beyond which the wheels may have slipped
FLOOR = 1e6  # information that holds the apparent scale of a floor line at 1
NEW = 1.0  # metres, radians: standard deviation of a line that began in the window
LEAST = 3e-4  # metres, radians: no reading of the odometer is better


class FixedLagConfig(eqx.Module):
    """How much is smoothed while driving."""

    keyframes: int = eqx.field(static=True, default=0)  # W; 0: nothing
    lines: int = eqx.field(static=True, default=128)  # J, the nearest of the map are solved for
    step: float = 0.2  # metres between keyframes ...
    turn: float = 0.15  # ... or radians


class Keyframe(eqx.Module):
    """An image that stays open."""

    T_world_robot: SE2
    tilt: Float[Array, "*batch 2"]  # jitter (pitch, roll), radians
    measurements: Measurements  # [*batch, M]
    motion: SE2  # since the keyframe before, as read ...
    way: Float[Array, "*batch 3"]  # ... how far that was, of `way_of`, ...
    unknown: Float[Array, "*batch 3"]  # ... and the variance of what was not read of it
    trust: Float[Array, "*batch"]  # in that reading: less than 1 where the wheels may have slipped
    bias: OdometerBias  # what was trusted of its errors


class Known(eqx.Module):
    """What is known of lines by keyframes that are not open any more."""

    line: Float[Array, "K 3"]  # (rho, theta, apparent scale) about the anchor
    information: Float[Array, "K 3 3"]


class Window(eqx.Module):
    """What is carried from one image to the next."""

    keyframes: Keyframe  # [W], the latest last
    count: Int[Array, ""]  # of keyframes so far
    known: Known  # of all lines of the map
    motion: SE2  # since the latest keyframe, as read
    way: Float[Array, "3"]
    unknown: Float[Array, "3"]  # variance of what was not read of it


def empty_window(rules: FixedLagConfig, capacity: int, measurements: Measurements) -> Window:
    """**Arguments:** `capacity`: K of the map. `measurements`: any, for their number M."""
    zero = SE2.identity()
    bias = OdometerBias(jnp.zeros(BIAS), jnp.eye(BIAS))
    none = jnp.zeros(3)
    one = Keyframe(zero, jnp.zeros(2), measurements, zero, none, none, jnp.zeros(()), bias)
    frames = jax.tree.map(lambda a: jnp.zeros((rules.keyframes, *a.shape), a.dtype), one)
    known = Known(jnp.zeros((capacity, 3)), jnp.zeros((capacity, 3, 3)))
    return Window(frames, jnp.zeros((), int), known, zero, none, none)


def slide(
    rules: FixedLagConfig, map_config: MapConfig, sensor: SensorModel, model: MotionModel,
    window: Window, segment_map: SegmentMap, T_robot_nadir: SE2, odometer: SE2,
    T_world_robot: SE2, tilt: Float[Array, "2"], bias: OdometerBias, measurements: Measurements,
    new: Int[Array, "M"], reach: Float[Array, ""] | float,
    unknown: Float[Array, "3"] | None = None,
) -> tuple[Window, SegmentMap, SE2]:  # fmt: skip
    """Take an image into account; if it is a keyframe, solve for the window that it ends.

    **Arguments:**
    - `odometer`: the motion since the last image, as read.
    - `T_world_robot`, `tilt`, `bias`: what the filter makes of the image.
    - `new`: slots of the lines that began with the measurements, K for none.
    - `reach`: metres to the farthest line that may be seen.
    - `unknown`: standard deviation of what was not read of the motion, if there is such.

    **Returns:** the window, the map, and T_new_old, by which all that moves with the robot is to
    be moved: the identity if the image is no keyframe, or the solution is not finite.
    """
    loosely = jnp.diag(jnp.array([NEW, NEW, map_config.scale_sigma]) ** -2)
    put = lambda a, b: a.at[new].set(b, mode="drop")
    begun = segment_map.line.at[new].get(mode="clip")
    known = Known(put(window.known.line, begun), put(window.known.information, loosely))
    motion, way = window.motion @ odometer, window.way + way_of(odometer)
    variance = window.unknown + (0 if unknown is None else unknown**2)
    window = Window(window.keyframes, window.count, known, motion, way, variance)

    usable = measurements.valid & ~measurements.upright
    far = (way[0] >= rules.step) | (way[1] - way[2] >= rules.turn)
    due = usable.any() & (far | (window.count == 0))

    last = jax.tree.map(lambda a: a[-1], window.keyframes.T_world_robot)
    off = last.between(T_world_robot).log() - read_twist(motion, way, bias.mean)
    error = jnp.sum((off / odometer_sigma(model, way, LEAST, variance)) ** 2)
    trust = jnp.minimum(1, jnp.sqrt(SLIPPED / jnp.maximum(error, 1e-6)))
    trust = jnp.where(window.count == 0, 0, trust)
    measurements = eqx.tree_at(lambda s: s.valid, measurements, usable)
    frame = Keyframe(T_world_robot, tilt, measurements, motion, way, variance, trust, bias)
    solve = lambda: _solve(
        rules, map_config, sensor, model, window, segment_map, T_robot_nadir, frame, reach
    )
    return jax.lax.cond(due, solve, lambda: (window, segment_map, SE2.identity()))


def _solve(rules, map_config, sensor, model, window, segment_map, T_robot_nadir, frame, reach):
    W, count = rules.keyframes, window.count + 1
    T_world_nadir = frame.T_world_robot @ T_robot_nadir
    slots, _ = nearby(map_config, segment_map, T_world_nadir, reach, rules.lines)
    lines = segment_map.take(slots)
    known = jax.tree.map(lambda a: a.at[slots].get(mode="clip"), window.known)
    none = Known(lines.line, jnp.broadcast_to(jnp.eye(3), known.information.shape))
    known = _where(lines.valid, known, none)

    frames = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), window.keyframes, frame)
    look = lambda frame: _look(map_config, sensor, lines, frame, T_robot_nadir)
    shown = jax.vmap(look)(frames)
    linear = lambda shown, frames, line: _linear(shown, frames, lines.anchor, line, T_robot_nadir)
    oldest, (shown, frames) = (
        jax.tree.map(lambda a, s=s: a[s], (shown, frames)) for s in (slice(0, 1), slice(1, None))
    )
    known = _learned(known, lines.line, linear(*oldest, lines.line))

    off_floor = is_off_floor(map_config, lines.line, lines.covariance)
    line = lines.line.at[:, 2].set(jnp.where(off_floor, lines.line[:, 2], 1))
    floor = jnp.where(off_floor, 0, FLOOR)
    first = jnp.maximum(W - count, 0)  # it holds its pose, as do those that are none yet
    held = jnp.append(jnp.repeat(jnp.arange(W) <= first, POSE), jnp.zeros(BIAS, bool))
    solved, bias = frames, frame.bias.mean
    posterior_given_class = jax.tree.map(lambda a: a[first], frames.bias)
    for _ in range(ROUNDS):
        odometry = lambda x, f=solved, b=bias: _odometry(
            model, sensor, f, b, posterior_given_class, x
        )
        step, line = _step(linear(shown, solved, line), known, floor, odometry, held, line)
        solved, bias = _moved(solved, step[:-BIAS]), bias + step[-BIAS:]

    # given the poses, the lines once more, with the apparent scale free
    at_lines = linear(shown, solved, lines.line)
    learned = _learned(known, lines.line, at_lines)
    fine = jnp.array([jnp.isfinite(a).all() for a in jax.tree.leaves((solved, learned))]).all()
    seen = _by_line(at_lines, at_lines.there.astype(int)) > 0
    moved = eqx.tree_at(
        lambda m: (m.line, m.covariance, m.segments_world.endpoints), lines,
        (learned.line, jnp.linalg.inv(learned.information), _laid(lines, learned.line)),
    )  # fmt: skip
    segment_map = segment_map.put(slots, _where(fine & seen, moved, lines))
    frames = jax.tree.map(lambda a, b: jnp.where(fine, a, b), solved, frames)
    put = lambda a, b: jnp.where(fine, a.at[slots].set(b, mode="drop"), a)
    of_all = jax.tree.map(put, window.known, known)
    latest = jax.tree.map(lambda a: a[-1], frames.T_world_robot)
    window = Window(frames, count, of_all, SE2.identity(), jnp.zeros(3), jnp.zeros(3))
    return window, segment_map, latest @ frame.T_world_robot.inverse()


def _where(condition, a, b):
    """By the first axis of all leaves."""
    some = lambda a, b: jnp.where(condition.reshape(-1, *[1] * (a.ndim - 1)), a, b)
    return jax.tree.map(some, a, b)


class _Shown(eqx.Module):
    """What the segments of an image show."""

    line: Int[Array, "*batch M"]  # of the J lines
    there: Bool[Array, "*batch M"]
    polar: Float[Array, "*batch M 2"]  # (rho, theta) by the line's name, before the jitter
    precision: Float[Array, "*batch M 2 2"]  # zero where none is shown
    by_tilt: Float[Array, "*batch M 2 2"]  # what the jitter adds to it


def _look(rules, sensor, lines, frame: Keyframe, T_robot_nadir) -> _Shown:
    measurements, T_world_nadir = frame.measurements, frame.T_world_robot @ T_robot_nadir
    level = eqx.tree_at(lambda s: s.line, measurements, measurements.under_tilt(frame.tilt))
    _, at, error = candidate_associations(rules, sensor, lines, level, T_world_nadir, most=1)
    at, there = at[:, 0], measurements.valid & (error < GATE)
    of_each = jax.tree.map(lambda a: a[at], (lines.line, lines.anchor))
    expected, _ = jax.vmap(predict_measurement, in_axes=(0, 0, None))(*of_each, T_world_nadir)
    line = PolarLine(expected[:, 0], expected[:, 1])
    side = alignment(line, measurements.line)
    covariance = rename_covariance(measurements.covariance, side)
    precision = inverse_2x2(jnp.where(there[:, None, None], covariance, jnp.eye(2)))
    return _Shown(
        at, there,
        polar=expected[:, :2] - polar_difference(line, measurements.line),
        precision=jnp.where(there[:, None, None], precision, 0),
        by_tilt=measurements.tilt * jnp.stack([side, jnp.ones_like(side)], axis=1)[..., None],
    )  # fmt: skip


class _Linear(eqx.Module):
    """Errors of the measurements of some keyframes, and how they fall with what is solved for."""

    line: Int[Array, "F M"]
    there: Bool[Array, "F M"]
    error: Float[Array, "F M 2"]
    by_pose: Float[Array, "F M 2 5"]
    by_line: Float[Array, "F M 2 3"]
    weight: Float[Array, "F M 2 2"]
    lines: int = eqx.field(static=True)  # J


def _linear(shown: _Shown, frames: Keyframe, anchor, line, T_robot_nadir) -> _Linear:
    def of_measurement(T, line, anchor):
        seen = lambda move, line: predict_measurement(
            line, anchor, T @ SE2.exp(move) @ T_robot_nadir
        )[0][:2]
        still = jnp.zeros(3)
        return seen(still, line), *jax.jacfwd(seen, argnums=(0, 1))(still, line)

    of_each = jax.tree.map(lambda a: a[shown.line], (line, anchor))
    of_image = jax.vmap(of_measurement, in_axes=(None, 0, 0))
    expected, by_motion, by_line = jax.vmap(of_image)(frames.T_world_robot, *of_each)
    error = shown.polar - expected - jnp.einsum("fmij,fj->fmi", shown.by_tilt, frames.tilt)
    squared = jnp.where(shown.there, mahalanobis(error, shown.precision), 0)
    return _Linear(
        shown.line, shown.there, error,
        by_pose=jnp.concatenate([by_motion, shown.by_tilt], axis=-1),
        by_line=by_line,
        weight=shown.precision / (1 + squared / HALF)[..., None, None],
        lines=len(line),
    )  # fmt: skip


def _by_line(linear: _Linear, a: Array) -> Array:
    return jax.ops.segment_sum(a.reshape(-1, *a.shape[2:]), linear.line.reshape(-1), linear.lines)


def _of_lines(known: Known, about: Float[Array, "J 3"], linear: _Linear) -> tuple[Array, Array]:
    """Normal equations [J, 3, 3] and [J, 3] of the lines' steps from `about`, given the poses."""
    JW = jnp.einsum("fmia,fmij->fmaj", linear.by_line, linear.weight)
    gradient = _by_line(linear, jnp.einsum("fmaj,fmj->fma", JW, linear.error))
    prior = jnp.einsum("kab,kb->ka", known.information, known.line - about)
    return known.information + _by_line(linear, JW @ linear.by_line), gradient + prior


def _learned(known: Known, about: Float[Array, "J 3"], linear: _Linear) -> Known:
    """The lines' information with that of further measurements, linearised about `about`."""
    information, gradient = _of_lines(known, about, linear)
    return Known(about + jnp.linalg.solve(information, gradient[..., None])[..., 0], information)


def _odometry(
    model, sensor, frames: Keyframe, bias, posterior_given_class: OdometerBias, x
) -> Array:
    """Residuals of all that is no measurement after a step x: readings, jitters, errors of them."""
    pose, b = x[:-BIAS].reshape(-1, POSE), bias + x[-BIAS:]
    T = frames.T_world_robot @ SE2.exp(pose[:, :3])
    before, after, read = (
        jax.tree.map(lambda a, s=s: a[s], t)
        for t, s in ((T, slice(-1)), (T, slice(1, None)), (frames, slice(1, None)))
    )
    twist = jax.vmap(read_twist, in_axes=(0, 0, None))(read.motion, read.way, b)
    sigma = jax.vmap(odometer_sigma, in_axes=(None, 0, None, 0))(
        model, read.way, LEAST, read.unknown
    )
    off = (before.between(after).log() - twist) / sigma * read.trust[:, None]
    jitter = (frames.tilt + pose[:, 3:]) / jnp.maximum(sensor.tilt_sigma, 1e-7)
    root = jnp.linalg.cholesky(posterior_given_class.covariance + 1e-10 * jnp.eye(BIAS))
    prior = solve_triangular(root, b - posterior_given_class.mean, lower=True)
    return jnp.concatenate([off.reshape(-1), jitter.reshape(-1), prior])


def _step(linear: _Linear, known: Known, floor, odometry, held, line):
    """One of Gauss-Newton: that of the poses and the odometer's errors, and the lines after it."""
    W, n = len(linear.error), held.shape[0]
    JpW = jnp.einsum("wmia,wmij->wmaj", linear.by_pose, linear.weight)
    JlW = jnp.einsum("wmia,wmij->wmaj", linear.by_line, linear.weight)
    zero = jnp.zeros(n)
    r, J = odometry(zero), jax.jacfwd(odometry)(zero)
    of_pose = jnp.einsum("wmaj,wmjb,wv->wavb", JpW, linear.by_pose, jnp.eye(W))
    A = J.T @ J + jnp.pad(of_pose.reshape(W * POSE, W * POSE), (0, BIAS))
    b = jnp.pad(jnp.einsum("wmaj,wmj->wa", JpW, linear.error).reshape(-1), (0, BIAS)) - J.T @ r

    # of the lines, and between those and the poses
    C, c = _of_lines(known, line, linear)
    C, c = C.at[:, 2, 2].add(floor), c.at[:, 2].add(floor * (1 - line[:, 2]))
    frame = jnp.broadcast_to(jnp.arange(W)[:, None], linear.line.shape)
    E = jnp.zeros((linear.lines, W, 3, POSE)).at[linear.line, frame].add(JlW @ linear.by_pose)
    E = jnp.pad(jnp.swapaxes(E, 1, 2).reshape(-1, 3, W * POSE), [(0, 0), (0, 0), (0, BIAS)])

    S = jnp.linalg.solve(C, jnp.concatenate([E, c[..., None]], axis=2))
    A, b = A - jnp.einsum("kax,kay->xy", E, S[..., :-1]), b - jnp.einsum("kax,ka->x", E, S[..., -1])
    A, b = jnp.where(held[:, None] | held, jnp.eye(n), A), jnp.where(held, 0, b)
    scale = jnp.diag(A) ** -0.5  # metres and radians
    x = scale * cho_solve(cho_factor(A * scale[:, None] * scale), scale * b)
    return x, line + S[..., -1] - S[..., :-1] @ x


def _moved(frames: Keyframe, step) -> Keyframe:
    step = step.reshape(-1, POSE)
    T = frames.T_world_robot @ SE2.exp(step[:, :3])
    return eqx.tree_at(lambda f: (f.T_world_robot, f.tilt), frames, (T, frames.tilt + step[:, 3:]))


def _laid(lines: SegmentMap, line: Float[Array, "J 3"]) -> Float[Array, "J 2 2"]:
    """The segments where their lines are now, in the world."""
    polar = PolarLine(line[:, 0] / line[:, 2], line[:, 1])
    ends = jax.vmap(lambda T, e: T.inverse().apply(e))(lines.anchor, lines.segments_world.endpoints)
    d = direction(polar)[:, None]
    along = jnp.sum(ends * d, axis=2, keepdims=True)
    ends = polar.rho[:, None, None] * normal(polar)[:, None] + along * d
    return jax.vmap(SE2.apply)(lines.anchor, ends)
