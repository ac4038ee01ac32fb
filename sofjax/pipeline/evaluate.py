"""`evaluate_run`: a run's files against the truth of its drive."""

from dataclasses import dataclass
from pathlib import Path

from sofjax.evaluation import (
    MapErrors,
    TrajectoryErrors,
    evaluate_map,
    evaluate_trajectory,
    shared,
)
from sofjax.io.drive import check_folder, read_odometry, read_truth
from sofjax.io.errors import InputError
from sofjax.io.json_text import read_json
from sofjax.io.map_file import read_map
from sofjax.io.odometry import mend
from sofjax.io.trajectory import read_trajectory
from sofjax.pipeline import run_folder


@dataclass(frozen=True)
class RunEvaluation:
    """How far a run is from the truth; None for what is not there to be compared."""

    name: str  # of the drive
    trajectory: TrajectoryErrors
    smoothed: TrajectoryErrors | None
    odometry: TrajectoryErrors | None
    map: MapErrors | None


def evaluate_run(folder: Path, drive: Path | None = None) -> RunEvaluation:
    """The errors of a run.

    **Arguments:**
    - `folder`: of the run.
    - `drive`: the folder of its drive; that of the run's report by default.

    **Raises:** `InputError` if a file is missing or cannot be read, or the times do not meet.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder; give one that a run has written")
    drive = check_folder(drive or _drive_of(folder / run_folder.REPORT))
    truth, true_segments = read_truth(drive)
    if truth is None:
        raise InputError(
            f"{drive / 'groundtruth.txt'}: the true path is missing, and there is nothing to "
            "compare with"
        )
    estimate = read_trajectory(folder / run_folder.TRAJECTORY, "the trajectory of the run")
    errors, motion = evaluate_trajectory(truth, estimate)
    smoothed, of_the_map = None, (estimate, motion)
    if (folder / run_folder.SMOOTHED).exists():
        path = folder / run_folder.SMOOTHED
        estimate = read_trajectory(path, "the smoothed trajectory of the run")
        smoothed, motion = evaluate_trajectory(truth, estimate)
        if not _map_is_driven(folder):
            of_the_map = estimate, motion
    odometry = None
    if (drive / "odometry.txt").exists():
        read = read_odometry(drive / "odometry.txt")
        mended, _ = mend("odometry.txt", read.lines, read.trajectory)
        odometry, _ = evaluate_trajectory(truth, mended.at(estimate.stamps))
    of_map = None
    if true_segments is not None and (folder / run_folder.MAP).exists():
        segments, _ = read_map(folder / run_folder.MAP)
        path, motion = of_the_map
        of_map = evaluate_map(true_segments, segments, motion, shared(truth, path).xy)
    return RunEvaluation(drive.resolve().name, errors, smoothed, odometry, of_map)


def _map_is_driven(folder: Path) -> bool:
    """Whether the run was killed before it wrote the map that goes with its smoothed trajectory."""
    try:
        of_map = _entry(folder / run_folder.REPORT, "map")
        return (
            isinstance(of_map, dict)
            and of_map["of"] == run_folder.TRAJECTORY
            and of_map["sha256"] == run_folder.digest(folder / run_folder.MAP)
        )
    except (OSError, InputError, LookupError):
        return False


def _drive_of(report: Path) -> Path:
    """The drive that a report names."""
    try:
        drive = _entry(report, "drive")
    except InputError as error:
        raise InputError(f"{error}; name the drive as a second argument") from None
    except LookupError:
        drive = None
    if not isinstance(drive, str):
        raise InputError(f"{report}: names no drive; give it as a second argument")
    return Path(drive)


def _entry(report: Path, name: str) -> object:
    """What a run's report has under a name. **Raises:** `InputError`, `LookupError`."""
    document = read_json(report, "the report of the run")
    if not isinstance(document, dict):
        raise LookupError(name)
    return document[name]
