"""Association and least squares alternate: which segment shows which line, which lines are one.

Associations that were made online bake the mistakes of the moment in; with the poses of a solution
they are made anew, and then the solution is found anew.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sofjax._checks import check_fields
from sofjax._pytree import in_double
from sofjax.extraction.observation import Observation
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.se2 import SE2
from sofjax.motion import without_unread_motions
from sofjax.segment_map import (
    MapConfig,
    SegmentMap,
    is_off_floor,
    on_floor,
    scale_is_off_floor,
)
from sofjax.slam.config import SlamConfig
from sofjax.smoothing import keyframes as kf
from sofjax.smoothing.association.duplicates import duplicates, representatives
from sofjax.smoothing.association.extents import reaches
from sofjax.smoothing.association.lines import Lines, Seeing, associate, lines_of
from sofjax.smoothing.association.revisits import apart, measurements, renamed, without_bent
from sofjax.smoothing.problem import (
    Keyframes,
    Priors,
    Problem,
    Unknowns,
    corrected,
    rms_distance,
)
from sofjax.smoothing.solution import TOLERANCE, Solution, solve
from sofjax.smoothing.sparse.dissection import Dissection, dissect, divide

ROUGH = 2e-3  # metres and radians to which poses settle in rounds that are not the last
NARROW = 32  # segments of a keyframe that are solved for, if more do not show a line


class SmoothingConfig(eqx.Module):
    """When a drive is smoothed, and how."""

    mount_sigma: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)  # height, pitch, roll, yaw; 0: fixed
    loss_scale: float = 3.0  # residuals, in sigmas, from which they count linearly only
    rounds: int = eqx.field(static=True, default=3)  # of association and solution
    step: float = 0.25  # heights of the camera between keyframes ...
    turn: float = 0.1  # ... or radians
    min_measurements: int = 3  # keyframes that a line takes
    room: int = eqx.field(static=True, default=kf.PAD)  # least sizes of what is compiled
    passing: float = 10.0  # metres driven after which a revisit starts a new line
    seeing: Seeing = Seeing()

    def __check_init__(self) -> None:
        check_fields(
            self,
            whole_from={"rounds": 1, "room": 1},
            positive=("loss_scale", "step", "turn"),
            at_least_zero=("min_measurements",),
        )


DEFAULT = SmoothingConfig()


class Path(eqx.Module):
    """What a drive was taken to be, image by image."""

    T_world_robot: SE2  # [T]
    tilt: Float[Array, "T 2"]  # jitter (pitch, roll) of each image, radians
    bias: Float[Array, "4"]  # the odometer's errors in the end


class Smoothed(eqx.Module):
    """The whole drive solved for. Arrays are of float64, on the host."""

    T_world_robot: SE2  # [T] all images, moved along with their keyframes
    index: Int[np.ndarray, "n"]  # the keyframes' images
    mount: Mount  # with what was found of it
    lines: Lines  # [K]
    endpoints_world: Float[Array, "K 2 2"]  # of the lines, metres
    measurements: Int[Array, "K"]  # segments that show each line
    problem: Problem  # as it stood at the last solution; its keyframes [n'] are padded
    solution: Solution
    costs: list[tuple[float, float]]  # before and after each solution
    merged: int  # lines that went on as another


def smooth(
    config: SlamConfig,
    camera: Camera,
    mount: Mount,
    log: Observation,
    path: Path,
    segment_map: SegmentMap,
    rules: SmoothingConfig = DEFAULT,
) -> Smoothed:
    """Poses, lines, the odometer's errors and, where its prior is not zero, the mount, at once.

    In float64, whatever the caller's precision is.

    **Arguments:**
    - `config`: with which the filter ran; what it says of noise, range and heights holds here.
    - `mount`: from which the fit starts, and at which it stays where `rules.mount_sigma` is zero.
    - `log`: the drive's observations, leading T, of two images or more.
    - `path`, `segment_map`: as the filter left them.

    **Returns:** the last round's solution; `solution.converged` says whether it settled.
    """
    config, priors = config.in_metres(camera, mount), _priors(config, rules)
    gap = rules.seeing.join_gap * float(mount.height)
    rules = eqx.tree_at(lambda r: r.seeing.join_gap, rules, gap)
    log = without_unread_motions(log)
    with jax.enable_x64(True):
        given = config, camera, mount, log, path, segment_map, rules, priors
        config, camera, mount, log, path, segment_map, rules, priors = in_double(given)
        index = kf.choose(path.T_world_robot, float(rules.step * mount.height), float(rules.turn))
        frames = kf.gather(log, index, rules.room)
        lines = _lines_of_map(config.segment_map, segment_map, rules)
        start = _start(path, kf.filled(index, len(frames.way)), lines)
        problem = Problem(
            camera, mount, config.motion, priors, frames, lines.anchor, lines.off_floor, start
        )
        solver = _Solver(config, rules, divide(np.asarray(start.pose[:, :2])))
        problem, lines, solution = _alternate(solver, problem, lines, frames)
        pose = problem.start.pose
        return jax.device_get(
            Smoothed(
                T_world_robot=kf.carry(path.T_world_robot, index, SE2(pose[:, :2], pose[:, 2])),
                index=index,
                mount=corrected(mount, problem.start.shared),
                lines=lines,
                endpoints_world=jax.jit(lambda lines: lines.endpoints_world)(lines),
                measurements=measurements(problem.keyframes, lines),
                problem=problem,
                solution=solution,
                costs=solver.costs,
                merged=solver.merged,
            )
        )


@dataclasses.dataclass
class _Solver:
    """What the solutions of one drive share."""

    config: SlamConfig
    rules: SmoothingConfig
    leaf: np.ndarray  # which part of the plane each keyframe is in
    dissection: Dissection | None = None  # the last one, whose sizes the next one keeps
    costs: list[tuple[float, float]] = dataclasses.field(default_factory=list)
    merged: int = 0

    def solve(
        self, problem: Problem, lines: Lines, tolerance: float, sure: bool = True
    ) -> tuple[Problem, Lines, Solution]:
        """The problem and the lines as they are at the solution, and the solution."""
        self.dissection = dissect(problem.keyframes, len(lines.valid), self.leaf, self.dissection)
        problem = eqx.tree_at(
            lambda p: (p.anchor, p.off_floor), problem, (lines.anchor, lines.off_floor)
        )
        solution = solve(problem, self.dissection, sure=sure, tolerance=tolerance)
        self.costs.append((float(solution.cost_before), float(solution.cost)))
        return *_settled(self.config, problem, lines, solution), solution


def _alternate(
    solver: _Solver, problem: Problem, lines: Lines, frames: Keyframes
) -> tuple[Problem, Lines, Solution]:
    """Rounds of association and least squares; duplicate lines are merged in each."""
    config, rules, solution = solver.config, solver.rules, None
    problem = _associated(config, rules, problem, lines, frames)
    problem, lines = apart(
        problem, lines, float(rules.passing), int(rules.min_measurements), rules.room
    )
    for left in reversed(range(rules.rounds)):
        if left < rules.rounds - 1:
            problem = _associated(config, rules, problem, lines, frames)
        tolerance = ROUGH if left else TOLERANCE
        problem, lines, solution = solver.solve(problem, lines, tolerance)
        problem, lines, bent = _straight(config, problem, lines)
        shown = measurements(problem.keyframes, lines)
        into, joins = duplicates(lines, solution.marginals, shown)
        if bent or joins.any():
            solver.merged += int(joins.sum())
            problem, lines = renamed(problem, lines, representatives(into, joins))
            problem, lines, solution = solver.solve(problem, lines, tolerance, sure=left == 0)
    problem, lines, bent = _straight(config, problem, lines)
    if bent or solution is None:  # what was joined last and is no line
        problem, lines, solution = solver.solve(problem, lines, TOLERANCE)
    return problem, lines, solution


def _priors(config: SlamConfig, rules: SmoothingConfig) -> Priors:
    return Priors(
        pixel_sigma=config.sensor.pixel_sigma,
        loss_scale=rules.loss_scale,
        tilt_sigma=config.sensor.tilt_sigma,
        mount_sigma=rules.mount_sigma,
        scale_sigma=config.segment_map.scale_sigma,
    )


def _lines_of_map(rules: MapConfig, m: SegmentMap, smoothing: SmoothingConfig) -> Lines:
    """The map's lines that were seen often enough to be worth a solution."""
    live = np.flatnonzero(np.asarray(m.valid & (m.updates >= int(smoothing.min_measurements))))
    K = kf.padded(max(len(live), 1), smoothing.room)
    slots = np.concatenate([live, np.zeros(K - len(live), int)])
    return _chosen(rules, m, slots, len(live))


@jax.jit
def _chosen(rules: MapConfig, m: SegmentMap, slots: Array, count: Array | int) -> Lines:
    m = jax.tree.map(lambda a: a[slots], m)
    off_floor = is_off_floor(rules, m.line, m.covariance)
    line = jnp.where(off_floor[:, None], m.line, jax.vmap(on_floor)(m.line, m.covariance))
    real = jnp.arange(slots.shape[0]) < count
    return lines_of(m.anchor, line, m.segments_world.endpoints, off_floor, real)


def _start(path: Path, at: np.ndarray, lines: Lines) -> Unknowns:
    T, tilt = path.T_world_robot, path.tilt
    pose = jnp.concatenate([T.xy[at], T.yaw[at, None], tilt[at]], axis=1)
    return Unknowns(pose, lines.line, jnp.concatenate([jnp.zeros(4), path.bias]))


def _associated(
    config: SlamConfig, rules: SmoothingConfig, problem: Problem, lines: Lines, frames: Keyframes
) -> Problem:
    """With the lines that the segments of `frames` show by the present estimate, and only those."""
    line, known = _shown(
        rules.seeing, config.filter.max_depth, config.sensor.upright, problem.camera, problem.mount,
        lines, problem.start, frames,
    )  # fmt: skip
    frames = eqx.tree_at(lambda f: (f.line, f.known), frames, (line, known))
    most = int(known.sum(axis=1).max())
    if problem.keyframes.known.any():  # as wide as before at least
        width = max(kf.padded(most, NARROW), problem.keyframes.known.shape[1])
    else:  # better poses show more lines: headroom against recompilation
        width = kf.padded(5 * most // 4, NARROW)
    frames = _narrowed(frames, min(width, known.shape[1]))
    return eqx.tree_at(lambda p: p.keyframes, problem, frames)


_narrowed = jax.jit(kf.narrowed, static_argnums=1)
_shown = jax.jit(associate)


@jax.jit
def _settled(
    config: SlamConfig, problem: Problem, lines: Lines, solution: Solution
) -> tuple[Problem, Lines]:
    m = config.segment_map
    apparent_scale, sigma = solution.scale_free, solution.scale_sigma
    off_floor = scale_is_off_floor(m, apparent_scale, sigma)
    # a line that may not be the floor's, as the top of a baseboard passed by, must not hold poses
    undetermined = ~off_floor & (sigma > m.scale_held)
    off_floor = off_floor | undetermined
    line = jnp.where(off_floor[:, None], solution.unknowns.line, solution.on_floor)
    unknowns = eqx.tree_at(lambda u: u.line, solution.unknowns, line)
    problem = eqx.tree_at(lambda p: p.start, problem, unknowns)
    problem = _with_pixel_sigma(config, problem)
    reach, seen = reaches(problem, m.range)
    reach = jnp.where(seen[:, None], reach, lines.reach)
    return problem, Lines(
        lines.anchor, line, reach, off_floor, lines.valid, lines.span, undetermined
    )


def _with_pixel_sigma(config: SlamConfig, problem: Problem) -> Problem:
    """The pixels are trusted less where they disagree more than they should."""
    sigma = jnp.maximum(rms_distance(problem), config.sensor.pixel_sigma)
    return eqx.tree_at(lambda p: p.priors.pixel_sigma, problem, sigma)


@jax.jit
def _straight(config: SlamConfig, problem: Problem, lines: Lines) -> tuple[Problem, Lines, Array]:
    problem, lines, bent = without_bent(problem, lines)
    return _with_pixel_sigma(config, problem), lines, bent
