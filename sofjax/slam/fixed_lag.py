"""Smoothing while driving: the last keyframes and the lines that they show, solved for together.

The filter puts a line where it is seen from the pose of the image, and takes no pose back. Here
the last W keyframes stay open: at each new one their poses, their attitude jitters, the odometer's
errors and the lines are solved for, and the particles move along with the latest. The oldest
keyframe is marginalised: what it saw becomes information on the lines, as if its last pose were
exact.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sofjax.extraction.observation import Observation
from sofjax.extraction.sof import View, keep_views
from sofjax.geometry.se2 import SE2
from sofjax.likelihood.measurements import Measurements
from sofjax.motion import OdometerBias, odometer_sigma, read_or_unknown, read_twist, way_of
from sofjax.segment_map import SegmentMap, is_off_floor, nearby
from sofjax.slam.bundle import (
    BIAS,
    LEAST,
    POSE,
    by_line,
    gauss_newton,
    laid,
    learned,
    linearise,
    look,
    moved,
    odometry_residuals,
    where_each,
)
from sofjax.slam.config import Setup
from sofjax.slam.keyframes import Keyframe, Known, Window
from sofjax.slam.state import SlamState, StepInfo

ROUNDS = 2  # of Gauss-Newton
SLIPPED = 9.0  # squared error of the odometer beyond which the wheels may have slipped
FLOOR = 1e6  # information that holds the apparent scale of a floor line at 1
NEW = 1.0  # metres, radians: standard deviation of a line that began in the window


class Mapped(eqx.Module):
    """What a round of Fig. 6 has seen and mapped, beside the state."""

    measurements: Measurements
    new_slots: Int[Array, "M"]  # of the lines that began with them; K for none


Round = Callable[[Setup, SlamState, Observation], tuple[SlamState, StepInfo, Mapped]]


def with_fixed_lag(one_round: Round) -> Callable[..., tuple[SlamState, StepInfo]]:
    """A step that does the round, and then solves for the last keyframes if there are any."""

    def step(
        setup: Setup, state: SlamState, observation: Observation
    ) -> tuple[SlamState, StepInfo]:
        after, info, mapped = one_round(setup, state, observation)
        if state.window is None:
            return after, info
        odometer, unread = read_or_unknown(observation.motion, observation.motion_sigma)
        bias = OdometerBias(info.bias, after.particles.bias.covariance)
        image = Image(info.T_world_robot, info.jitter, bias, mapped, odometer, unread)
        window, segment_map, T_new_old = slide(setup, state.window, after.segment_map, image)
        T_world_robot = T_new_old @ info.T_world_robot
        recent, reference = keep_views(
            setup.config.association, state.recent, state.reference,
            View(observation.segments_image, T_world_robot, after.consistency.T_odometer),
        )  # fmt: skip
        after = eqx.tree_at(
            lambda s: (
                s.particles.T_world_robot,
                s.consistency.T_world_robot,
                s.segment_map,
                s.recent,
                s.reference,
                s.window,
            ),
            after,
            (
                T_new_old @ after.particles.T_world_robot,
                T_new_old @ after.consistency.T_world_robot,
                segment_map,
                recent,
                reference,
                window,
            ),
        )
        return after, eqx.tree_at(lambda i: i.T_world_robot, info, T_world_robot)

    return step


class Image(eqx.Module):
    """An image as the filter has understood it."""

    T_world_robot: SE2
    jitter: Float[Array, "2"]
    bias: OdometerBias
    mapped: Mapped
    odometer: SE2  # the motion since the last image, as read
    unread_sigma: Float[Array, "3"]  # standard deviation of what was not read of it


def slide(
    setup: Setup, window: Window, segment_map: SegmentMap, image: Image
) -> tuple[Window, SegmentMap, SE2]:
    """Take an image into account; if it is a keyframe, solve for the window that it ends.

    **Returns:** the window, the map, and T_new_old, by which all that moves with the robot is to
    be moved: the identity if the image is no keyframe, or the solution is not finite.
    """
    config, map_config = setup.config.window, setup.config.segment_map
    measurements, new = image.mapped.measurements, image.mapped.new_slots
    loosely = jnp.diag(jnp.array([NEW, NEW, map_config.scale_sigma]) ** -2)
    put = lambda a, b: a.at[new].set(b, mode="drop")
    begun = segment_map.line.at[new].get(mode="clip")
    known = Known(put(window.known.line, begun), put(window.known.information, loosely))
    motion, way = window.motion @ image.odometer, window.way + way_of(image.odometer)
    variance = window.unread + image.unread_sigma**2
    window = Window(window.keyframes, window.count, known, motion, way, variance)

    usable = measurements.valid & jnp.logical_not(measurements.upright)
    far = (way[0] >= config.step) | (way[1] - way[2] >= config.turn)
    due = usable.any() & (far | (window.count == 0))

    last = jax.tree.map(lambda a: a[-1], window.keyframes.T_world_robot)
    off = last.between(image.T_world_robot).log() - read_twist(motion, way, image.bias.mean)
    sigma = odometer_sigma(setup.config.motion, way, LEAST, variance)
    error = jnp.sum((off / sigma) ** 2)
    trust = jnp.minimum(1, jnp.sqrt(SLIPPED / jnp.maximum(error, 1e-6)))
    trust = jnp.where(window.count == 0, 0, trust)
    measurements = eqx.tree_at(lambda s: s.valid, measurements, usable)
    frame = Keyframe(
        image.T_world_robot, image.jitter, measurements, motion, way, variance, trust, image.bias
    )
    solve = lambda: _solve(setup, window, segment_map, frame)
    return jax.lax.cond(due, solve, lambda: (window, segment_map, SE2.identity()))


def _solve(
    setup: Setup, window: Window, segment_map: SegmentMap, frame: Keyframe
) -> tuple[Window, SegmentMap, SE2]:
    config, map_config, sensor = setup.config.window, setup.config.segment_map, setup.config.sensor
    T_robot_nadir = setup.mount.T_robot_nadir
    W, count = config.keyframes, window.count + 1
    T_world_nadir = frame.T_world_robot @ T_robot_nadir
    slots, _ = nearby(
        map_config, segment_map, T_world_nadir, setup.config.filter.max_depth, config.lines
    )
    lines = segment_map.take(slots)
    known = jax.tree.map(lambda a: a.at[slots].get(mode="clip"), window.known)
    none = Known(lines.line, jnp.broadcast_to(jnp.eye(3), known.information.shape))
    known = where_each(lines.valid, known, none)

    frames = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), window.keyframes, frame)
    shown = jax.vmap(lambda frame: look(map_config, sensor, lines, frame, T_robot_nadir))(frames)
    linear = lambda shown, frames, line: linearise(shown, frames, lines.anchor, line, T_robot_nadir)
    oldest, (shown, frames) = (
        jax.tree.map(lambda a, s=s: a[s], (shown, frames)) for s in (slice(0, 1), slice(1, None))
    )
    known = learned(known, lines.line, linear(oldest[0], oldest[1], lines.line))

    off_floor = is_off_floor(map_config, lines.line, lines.covariance)
    line = lines.line.at[:, 2].set(jnp.where(off_floor, lines.line[:, 2], 1))
    floor = jnp.where(off_floor, 0, FLOOR)
    first = jnp.maximum(W - count, 0)  # it holds its pose, as do those that are none yet
    held = jnp.append(jnp.repeat(jnp.arange(W) <= first, POSE), jnp.zeros(BIAS, bool))
    solved, bias = frames, frame.bias.mean
    prior = jax.tree.map(lambda a: a[first], frames.bias)
    for _ in range(ROUNDS):
        odometry = lambda x, f=solved, b=bias: odometry_residuals(setup.config, f, b, prior, x)
        step, line = gauss_newton(linear(shown, solved, line), known, floor, odometry, held, line)
        solved, bias = moved(solved, step[:-BIAS]), bias + step[-BIAS:]

    # given the poses, the lines once more, with the apparent scale free
    at_lines = linear(shown, solved, lines.line)
    known_now = learned(known, lines.line, at_lines)
    fine = jnp.array([jnp.isfinite(a).all() for a in jax.tree.leaves((solved, known_now))]).all()
    seen = by_line(at_lines, at_lines.paired.astype(int)) > 0
    moved_lines = eqx.tree_at(
        lambda m: (m.line, m.covariance, m.segments_world.endpoints), lines,
        (known_now.line, jnp.linalg.inv(known_now.information), laid(lines, known_now.line)),
    )  # fmt: skip
    segment_map = segment_map.put(slots, where_each(fine & seen, moved_lines, lines))
    frames = jax.tree.map(lambda a, b: jnp.where(fine, a, b), solved, frames)
    put = lambda a, b: jnp.where(fine, a.at[slots].set(b, mode="drop"), a)
    of_all = jax.tree.map(put, window.known, known)
    latest = jax.tree.map(lambda a: a[-1], frames.T_world_robot)
    window = Window(frames, count, of_all, SE2.identity(), jnp.zeros(3), jnp.zeros(3))
    return window, segment_map, latest @ frame.T_world_robot.inverse()
