"""What is found in a drive: the map, errors against the truth where it is known, and warnings."""

from dataclasses import dataclass, field
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sofjax.evaluation import (
    MapErrors,
    RigidMotion,
    TrajectoryErrors,
    evaluate_map,
    evaluate_trajectory,
    shared,
)
from sofjax.io.drive import Drive
from sofjax.io.errors import InputError
from sofjax.io.trajectory import Trajectory
from sofjax.pipeline import setup_checks
from sofjax.pipeline.outcomes import LoopStatus
from sofjax.pipeline.run_log import RunLog
from sofjax.pipeline.settings import RunSettings
from sofjax.pipeline.stages import Closed, Driven
from sofjax.segment_map import FinalMap, final_map
from sofjax.slam.state import SlamState

UNOBSERVED = 5.0  # metres; R, within which a line across the heading is mapped and seen again
MOST_GIVEN_UP = 0.2  # share of the images; with more the run says so, ...
SOME = 20  # ... if there are so many
MOST_ON_FLOOR = 0.5  # share of the segments on the floor's side; with less the set-up is checked


class MapSegments(NamedTuple):
    """The final map's segments on the floor."""

    segments: np.ndarray  # [K, 2, 2] end points in the world, metres
    measurements: np.ndarray  # [K] how often each was seen
    height: np.ndarray  # [K] metres above the floor, by the views of the line
    left_out: int  # lines of the filter or the smoother that are not known to lie on the floor


@dataclass(frozen=True)
class Errors:
    """How far a drive's results are from the truth; None for what cannot be compared."""

    trajectory: TrajectoryErrors | None = None
    smoothed: TrajectoryErrors | None = None  # of the path found after the drive
    odometry: TrajectoryErrors | None = None  # of the odometry alone, at the same images
    map: MapErrors | None = None
    motion: RigidMotion | None = None  # of the map onto the truth
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class DriveResult:
    """What came out of a drive."""

    drive: Drive
    settings: RunSettings  # as used
    log: RunLog  # poses, counts and times of each image
    state: SlamState | None  # the filter's last, with all lines and particles
    closed: Closed | None  # what was solved after the drive
    map: MapSegments
    errors: Errors
    warnings: list[str]
    loop: dict[str, object]  # what was asked for after the drive, and how far it came
    interrupted: bool  # before all images were done
    seconds: dict[str, float] = field(default_factory=dict)  # that each stage took

    @property
    def segments(self) -> np.ndarray:
        """[K, 2, 2] end points of the map's segments on the floor, metres."""
        return self.map.segments

    @property
    def online(self) -> Trajectory:
        """The path as it was known while driving."""
        return self.log.trajectory

    @property
    def trajectory(self) -> Trajectory:
        """The path that the map goes with: as solved after the drive, else as driven."""
        return self.closed.trajectory if self.closed else self.online

    @property
    def given_up(self) -> int:
        """Images whose segments the odometer alone decided against."""
        return given_up(self.log, self.settings)

    @property
    def stopped(self) -> bool:
        """Whether Ctrl-C or a full disk ended the drive or what is solved after it."""
        return self.interrupted or self.loop.get("status") == LoopStatus.INTERRUPTED


def driven_map(drive: Drive, settings: RunSettings, state: SlamState | None) -> FinalMap | None:
    """The map as the drive left it, on the host; None without an image."""
    if state is None:
        return None
    final = eqx.filter_jit(final_map)  # one compilation for all its small operations
    return jax.device_get(
        final(settings.slam.segment_map, drive.camera_file.mount, state.segment_map)
    )


def find_results(
    driven: Driven, closed: Closed | None, status: LoopStatus | None, remarks: list[str]
) -> DriveResult:
    """The results of a drive, compared with the truth where it is known.

    **Arguments:**
    - `closed`: what was solved after the drive; then the map is of that.
    - `status`: how far that came; None if nothing was asked for.
    - `remarks`: sentences to add to the warnings.
    """
    drive, run_log = driven.drive, driven.log
    of_map = map_segments(driven, closed)
    errors = compare(drive, run_log, closed, of_map.segments) if run_log.stamps else Errors()
    found = [*warnings(drive, run_log, driven.settings), *errors.warnings, *remarks]
    if status == LoopStatus.INTERRUPTED and not driven.interrupted:
        found.append("interrupted while solving; the map is as it was after the drive")
    loop: dict[str, object] = {"asked": driven.settings.loop}
    loop |= {"status": status} if status else {}
    loop |= closed.report if closed else {}
    return DriveResult(
        drive=drive,
        settings=driven.settings,
        log=run_log,
        state=driven.state,
        closed=closed,
        map=of_map,
        errors=errors,
        warnings=found,
        loop=loop,
        interrupted=driven.interrupted,
    )


def map_segments(driven: Driven, closed: Closed | None) -> MapSegments:
    """The segments of the final map: of what was solved after the drive, else of the filter."""
    if driven.state is None or driven.final is None:
        return MapSegments(np.zeros((0, 2, 2)), np.zeros(0, int), np.zeros(0), 0)
    if closed is None:
        final, lines = driven.final, np.asarray(driven.state.segment_map.valid).sum()
    else:
        final, lines = closed.final, closed.report["lines"]
    keep = np.asarray(final.is_floor)
    endpoints, updates, height = (
        np.asarray(v)[keep]
        for v in (final.endpoints_world.astype(float), final.updates, final.height)
    )
    return MapSegments(endpoints, updates, height, int(lines - keep.sum()))


def compare(drive: Drive, run_log: RunLog, closed: Closed | None, segments: np.ndarray) -> Errors:
    """Errors against the truth; none if there is nothing to compare with."""
    if drive.groundtruth is None:
        return Errors()
    estimate = run_log.trajectory
    try:
        trajectory, motion = evaluate_trajectory(drive.groundtruth, estimate)
        odometry, _ = evaluate_trajectory(drive.groundtruth, drive.odometry.at(estimate.stamps))
    except InputError as error:
        return Errors(warnings=[f"no errors against the truth: {error}"])
    smoothed = of_map = None
    if closed:  # the map goes with its path
        estimate = closed.trajectory
        smoothed, motion = evaluate_trajectory(drive.groundtruth, estimate)
    if drive.floor_segments is not None:
        path = shared(drive.groundtruth, estimate).xy
        of_map = evaluate_map(drive.floor_segments, segments, motion, path)
    return Errors(trajectory, smoothed, odometry, of_map, motion)


def doubts_of(drive: Drive, settings: RunSettings, run_log: RunLog) -> list[str]:
    """Sentences on what the images say against the set-up."""
    found = setup_checks.odometer(run_log.odometer, settings.slam.motion)
    if run_log.step["associated"] < MOST_ON_FLOOR * run_log.step["below_horizon"]:
        log = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *run_log.observations)
        found += setup_checks.set_up(settings.slam, drive, log)
    return found


def given_up(run_log: RunLog, settings: RunSettings) -> int:
    """Images that contradicted the map or the odometer more than noise explains."""
    beyond = np.array(run_log.sensor_inflation) > float(settings.slam.sensor.noise_gate)
    if settings.slam.filter.doubting:
        beyond |= np.logical_not(run_log.trusted) & (np.array(run_log.floor_side) > 0)
    return int(beyond.sum())


def warnings(drive: Drive, run_log: RunLog, settings: RunSettings) -> list[str]:
    """Sentences on what was odd about the drive."""
    found = setup_checks.of_drive(drive) + run_log.doubts
    n = len(run_log.stamps)
    why = ", ".join(f"{len(files)} {fault}" for fault, files in run_log.faults.items())
    for count, text in (
        (len(run_log.unreadable), f"images could not be used ({why}); the odometry bridged them"),
        (run_log.without_segments, "images had no segment at all; the odometry bridged them"),
        (run_log.step["lost"], "images were lost: nothing seen was in the map for ten and more"),
    ):  # fmt: skip
        if count:
            found.append(f"{count} of {n} {text}")
    if run_log.overflow:
        found.append(
            f"{run_log.overflow} of {run_log.detected} segments did not fit in an observation "
            "(those above the horizon go first, then the shortest); frontend.capacity makes room"
        )
    if run_log.step["map_overflow"]:
        found.append(
            f"the map was full, and {run_log.step['map_overflow']} new lines found no place; "
            "segment_map.capacity makes room"
        )
    if run_log.step["map_truncated"]:
        found.append(
            "more lines lay within sight than are compared, "
            f"{run_log.step['map_truncated']} too many in {n} images; "
            "segment_map.nearby makes room"
        )
    contradicting = given_up(run_log, settings)
    if contradicting > max(MOST_GIVEN_UP * n, SOME):
        found.append(
            "the images contradict the map or the odometer more than noise explains, over "
            f"{contradicting} of {n} images; the odometer alone decided there: "
            "run `sofjax calibrate robot`"
        )
    if run_log.longest_without_across > UNOBSERVED:
        found.append(
            f"for {run_log.longest_without_across:.1f} m no line across the way was matched to "
            "the map: the distance driven there is the odometer's alone"
        )
    return found
