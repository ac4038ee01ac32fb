"""What a run leaves behind: the map, the figure, the report, and a summary for the terminal."""

import platform
import resource
import sys
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sofjax import slam, viewer
from sofjax.cli.errors_table import errors_table
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
from sofjax.io.map_file import write_map
from sofjax.io.settings import to_dict
from sofjax.io.trajectory import write_trajectory
from sofjax.pipeline import run_folder, setup_checks
from sofjax.pipeline.run_log import Closed, RunLog
from sofjax.pipeline.settings import RunSettings
from sofjax.segment_map import FinalMap, final_map

UNHELD = 5.0  # metres; R, within which a line across the way is mapped and holds the distance
FUNNEL = {  # units, and what each count of it means
    "images": "images: those that the filter took",
    "segments": "segments: found in the images, after undistortion and of the least length",
    "below_horizon": "segments: of these, on the floor's side of the horizon and within range",
    "associated": "segments: of these, moving as the floor does between two images, by eq. (9)",
    "matched": "segments: of these, showing a line that the map knew",
    "initialised": "lines: begun in the map",
    "mapped": "lines: in the final map, on the floor",
}
# how far the run came with what is solved after the drive
UNFINISHED = "not finished"  # stays in the report of a run that was killed
INTERRUPTED, SOLVED, NOTHING = "interrupted", "solved", "nothing to solve"
PACKAGES = ("sofjax", "jax", "jaxlib", "equinox", "numpy", "opencv-python-headless")


@dataclass
class Results:
    """What came out, beside the trajectory."""

    segments: np.ndarray  # [K, 2, 2], the map's segments on the floor, metres
    left_out: int  # lines that the filter kept and that are not known to lie on the floor
    interrupted: bool
    warnings: list[str]
    closed: Closed | None = None
    loop: dict[str, object] = field(default_factory=dict)  # what was asked for, how far it came
    motion: RigidMotion | None = None  # onto the truth, where it is known
    trajectory: TrajectoryErrors | None = None
    smoothed: TrajectoryErrors | None = None  # of the path found after the drive
    odometry: TrajectoryErrors | None = None  # of the odometry alone, at the same images
    map: MapErrors | None = None

    def add_loop(self, asked: str, status: str | None) -> None:
        """What was asked for after the drive and, if anything, how far it came."""
        self.loop = {"asked": asked} | ({"status": status} if status else {})
        self.loop |= self.closed.report if self.closed else {}
        if status == INTERRUPTED and not self.interrupted:
            self.warnings.append("interrupted while solving; the map is as it was after the drive")


def driven_map(
    drive: Drive, settings: RunSettings, state: slam.SlamState | None
) -> FinalMap | None:
    """The map as the drive left it, on the host."""
    if state is None:
        return None
    final = eqx.filter_jit(final_map)  # one compilation for all its small operations
    return jax.device_get(
        final(settings.slam.segment_map, drive.camera_file.mount, state.segment_map)
    )


def write_results(
    folder: Path,
    drive: Drive,
    run_log: RunLog,
    state: slam.SlamState | None,
    driven: FinalMap | None,
    closed: Closed | None,
    interrupted: bool,
) -> Results:
    """Write the map, and compare with the truth where it is known.

    **Arguments:**
    - `driven`: the map as the drive left it.
    - `closed`: what was solved after it, if it was; then the map is of that, and its path is
      written before it.
    """
    results = Results(np.zeros((0, 2, 2)), 0, interrupted, warnings(drive, run_log), closed)
    seen, height = np.zeros(0, int), np.zeros(0)
    if closed is not None:
        write_trajectory(folder / run_folder.SMOOTHED, closed.trajectory)
    if state is not None:
        if closed is None:
            final, lines = driven, np.asarray(state.segment_map.valid).sum()
        else:
            final, lines = closed.final, closed.report["lines"]
        keep = final.is_floor
        results.segments, seen, height = (
            v[keep] for v in (final.endpoints_world.astype(float), final.updates, final.height)
        )
        results.left_out = int(lines - keep.sum())
    write_map(folder / run_folder.MAP, results.segments, seen, height)
    results.motion = _compare(drive, run_log, results) if run_log.stamps else None
    if not viewer.available():
        results.warnings.append(viewer.MISSING)
    return results


def _compare(drive: Drive, run_log: RunLog, results: Results) -> RigidMotion | None:
    """Errors against the truth; the motion onto it, or None if nothing is there to compare with."""
    if drive.groundtruth is None:
        return None
    estimate = run_log.trajectory
    try:
        results.trajectory, motion = evaluate_trajectory(drive.groundtruth, estimate)
        odometry = drive.odometry.at(estimate.stamps)
        results.odometry, _ = evaluate_trajectory(drive.groundtruth, odometry)
    except InputError as error:
        results.warnings.append(f"no errors against the truth: {error}")
        return None
    if results.closed:  # of which the map is a part
        estimate = results.closed.trajectory
        results.smoothed, motion = evaluate_trajectory(drive.groundtruth, estimate)
    if drive.floor_segments is not None:
        path = shared(drive.groundtruth, estimate).xy
        results.map = evaluate_map(drive.floor_segments, results.segments, motion, path)
    return motion


def draw_figure(folder: Path, drive: Drive, run_log: RunLog, results: Results) -> None:
    """The figure in the frame of the truth if it is known, and in the map's otherwise.

    There is none without an image or without matplotlib.
    """
    if not (run_log.stamps and viewer.available()):
        return
    closed, motion = results.closed, results.motion
    estimate = closed.trajectory if closed else run_log.trajectory
    odometry = drive.odometry.at(estimate.stamps)
    turn = estimate.yaw[0] - odometry.yaw[0]
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    odometry = RigidMotion(R, estimate.xy[0] - R @ odometry.xy[0]).apply(odometry.xy)
    to_truth = motion or RigidMotion(np.eye(2), np.zeros(2))
    title = f"{drive.name}: {len(estimate.stamps)} images, {estimate.travelled[-1]:.1f} m"
    if results.trajectory:
        e = results.smoothed or results.trajectory
        title += f", {e.ate_m:.3f} m and {e.yaw_deg:.2f}° from the true path"
    viewer.draw_map(
        folder / run_folder.FIGURE,
        title,
        robot=to_truth.apply(estimate.xy),
        odometry=to_truth.apply(odometry),
        segments=to_truth.apply(results.segments),
        true_robot=drive.groundtruth.xy if motion else None,
        true_segments=drive.floor_segments if motion else None,
        online=to_truth.apply(run_log.trajectory.xy) if closed else None,
        ellipses=_ellipses(closed, to_truth) if closed else None,
    )


def _ellipses(closed: Closed, to_truth: RigidMotion) -> tuple[np.ndarray, np.ndarray]:
    """Middles and covariances at some thirty places of the path."""
    few = slice(0, None, max(1, len(closed.places) // 30))
    covariances = to_truth.R @ closed.covariances[few] @ to_truth.R.T
    return to_truth.apply(closed.places[few]), covariances


def doubts_of(drive: Drive, settings: RunSettings, run_log: RunLog) -> list[str]:
    """What the images betray about the set-up."""
    found = setup_checks.odometer(run_log.odometer, settings.slam.motion)
    if 2 * run_log.step["associated"] < run_log.step["below_horizon"]:
        log = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *run_log.observations)
        found += setup_checks.set_up(settings.slam, drive, log)
    return found


def warnings(drive: Drive, run_log: RunLog) -> list[str]:
    """Sentences on what was odd about the drive."""
    found = setup_checks.of_drive(drive) + run_log.doubts
    n = len(run_log.stamps)
    why = ", ".join(f"{len(files)} {fault}" for fault, files in run_log.faults.items())
    for count, text in (
        (len(run_log.unreadable), f"images could not be used ({why}); the odometry bridged them"),
        (run_log.blind, "images had no segment at all; the odometry bridged them"),
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
            f"more lines lay within sight than are compared, {run_log.step['map_truncated']} too "
            f"many in {n} images; segment_map.nearby makes room"
        )
    if run_log.unheld > UNHELD:
        found.append(
            f"for {run_log.unheld:.1f} m no line across the way was matched to the map: the "
            "distance driven there is the odometer's alone"
        )
    return found


def write_report(
    folder: Path,
    drive: Drive,
    settings: RunSettings,
    run_log: RunLog,
    results: Results,
    seconds: dict[str, float],
    mount: dict[str, object] | None = None,
) -> None:
    """`report.json`: all that there is to know about a run, for machines and for later.

    **Arguments:**
    - `mount`: what `--calibrate` found, if it was asked for.
    """
    run_folder.write_json(
        folder / run_folder.REPORT,
        {
            "drive": str(drive.path.resolve()),
            "interrupted": results.interrupted or results.loop.get("status") == INTERRUPTED,
            "seed": settings.seed,
            "settings": to_dict(settings),
            "calibration": mount,
            "versions": {"python": platform.python_version()}
            | {package: version(package) for package in PACKAGES},
            "device": f"{jax.default_backend()}, {platform.machine()}",
            "funnel": {
                "images": len(run_log.stamps),
                "segments": run_log.detected,
                "below_horizon": run_log.step["below_horizon"],
                "associated": run_log.step["associated"],
                "matched": run_log.step["reobserved"],
                "initialised": run_log.step["initialised"],
                "mapped": len(results.segments),
                "meaning": FUNNEL,
            },
            "left_out": results.left_out,
            "map": {  # if the file has another digest, the run was killed on the way to its report
                "of": run_folder.SMOOTHED if results.closed else run_folder.TRAJECTORY,
                "sha256": run_folder.digest(folder / run_folder.MAP),
            },
            "overflow": {"segments": run_log.overflow, "map": run_log.step["map_overflow"]},
            "images": {
                "listed": len(drive.image_files),
                "done": len(run_log.stamps),
                "without_segments": run_log.blind,
                "lost": run_log.step["lost"],
                "unreadable": run_log.unreadable,
            },
            "longest_without_lines_across_m": run_log.unheld,
            "loop": results.loop,
            "frames_per_second": run_log.frames_per_second,
            "milliseconds_per_image": run_log.milliseconds(),
            "seconds": seconds | {"first_image": sum(run_log.seconds[0].values())}
            if run_log.seconds
            else seconds,
            "peak_memory_mib": peak_memory(),
            "errors": {
                name: asdict(errors) if errors else None
                for name, errors in (
                    ("trajectory", results.trajectory),
                    ("smoothed", results.smoothed),
                    ("odometry", results.odometry),
                    ("map", results.map),
                )
            },
            "warnings": results.warnings,
        },
    )


def peak_memory() -> float:
    """MiB that the process has held at most."""
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def summary(
    folder: Path, drive: Drive, run_log: RunLog, results: Results, seconds: dict[str, float]
) -> str:
    """The run in a few lines for a person."""
    n, step = len(run_log.stamps), run_log.step
    way = run_log.trajectory.travelled[-1] if n else 0.0
    fps = run_log.frames_per_second
    stages = ", ".join(f"{stage} {ms:.1f}" for stage, ms in run_log.milliseconds().items())
    lines = [
        f"{drive.name}: {n} images, {way:.1f} m"
        + f"; interrupted before {len(drive.image_files) - n} more" * results.interrupted,
        f"  segments  {run_log.detected} found, {step['below_horizon']} of them on the floor's "
        f"side of the horizon, {step['associated']} of those",
        f"            associated by eq. (9), {step['reobserved']} of those matched to the map",
        f"  map       {len(results.segments)} segments on the floor; {results.left_out} lines left "
        "out, above it or seen too little",
        *_closing(results.closed),
        f"  time      {sum(seconds.values()):.1f} s"
        + (f"; {fps:.0f} frames a second ({stages} ms)" if fps else ""),
    ]
    if results.trajectory:
        lines += errors_table(results.trajectory, results.smoothed, results.odometry, results.map)
    lines += [f"  warning   {warning}" for warning in results.warnings]
    if run_log.unreadable:
        few = ", ".join(run_log.unreadable[:3])
        lines.append(f"            not read: {few}{' ...' * (len(run_log.unreadable) > 3)}")
    lines.append(f"written to {folder}/")
    return "\n".join(lines)


def _closing(closed: Closed | None) -> list[str]:
    """What the closing did, in a line."""
    if closed is None:
        return []
    r = closed.report
    loops = f"{r['accepted']} loops closed, {r['refused']} refused"
    if "keyframes" not in r:
        return [f"  closed    {loops}"]
    return [
        f"  smoothed  {r['keyframes']} keyframes and {r['lines']} lines in {r['seconds']:.1f} s, "
        f"{r['merged']} described twice; {loops}" + "; it did not settle" * (not r["converged"])
    ]
