"""`sofjax evaluate`: a run against the truth."""

import argparse
from pathlib import Path


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "evaluate",
        help="compare a run with the truth",
        description="Compare the trajectory and the map of a run with the truth of its drive.",
    )
    parser.add_argument("folder", metavar="RUN_DIR", type=Path, help="folder of the run")
    parser.add_argument(
        "drive", metavar="DRIVE", nargs="?", type=Path, help="default: the drive of the report"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    from sofjax.cli.errors_table import errors_table
    from sofjax.evaluation import evaluate_map, evaluate_trajectory, shared
    from sofjax.io.drive import check_folder, read_odometry, read_truth
    from sofjax.io.errors import InputError
    from sofjax.io.map_file import read_map
    from sofjax.io.odometry import mend
    from sofjax.io.trajectory import read_trajectory
    from sofjax.pipeline import run_folder

    if not args.folder.is_dir():
        raise InputError(f"{args.folder}: there is no such folder; give one that a run has written")
    drive = check_folder(args.drive or _drive_of(args.folder / run_folder.REPORT))
    truth, true_segments = read_truth(drive)
    if truth is None:
        raise InputError(
            f"{drive / 'groundtruth.txt'}: the true path is missing, and there is nothing to "
            "compare with"
        )
    estimate = read_trajectory(args.folder / run_folder.TRAJECTORY, "the trajectory of the run")
    errors, motion = evaluate_trajectory(truth, estimate)
    smoothed, of_the_map = None, (estimate, motion)
    if (args.folder / run_folder.SMOOTHED).exists():
        path = args.folder / run_folder.SMOOTHED
        estimate = read_trajectory(path, "the smoothed trajectory of the run")
        smoothed, motion = evaluate_trajectory(truth, estimate)
        if not _map_is_driven(args.folder):
            of_the_map = estimate, motion
    odometry = None
    if (drive / "odometry.txt").exists():
        read = read_odometry(drive / "odometry.txt")
        mended, _ = mend("odometry.txt", read.lines, read.trajectory)
        odometry, _ = evaluate_trajectory(truth, mended.at(estimate.stamps))
    of_map = None
    if true_segments is not None and (args.folder / run_folder.MAP).exists():
        segments, _ = read_map(args.folder / run_folder.MAP)
        path, motion = of_the_map
        of_map = evaluate_map(true_segments, segments, motion, shared(truth, path).xy)
    print(f"{args.folder} of {drive.resolve().name}: {errors.path_m:.1f} m")
    print("\n".join(errors_table(errors, smoothed, odometry, of_map)))
    if of_map is None:
        print("    the map is not compared: its file or floor_segments.csv is missing")
    return 0


def _map_is_driven(folder: Path) -> bool:
    """Whether the run was killed before it wrote the map that goes with its smoothed trajectory."""
    from sofjax.io.errors import InputError
    from sofjax.io.json_text import read_json
    from sofjax.pipeline import run_folder

    try:
        of_map = read_json(folder / run_folder.REPORT, "the report of the run")["map"]
        driven = of_map["of"] == run_folder.TRAJECTORY
        return driven and of_map["sha256"] == run_folder.digest(folder / run_folder.MAP)
    except (OSError, InputError, LookupError, TypeError):
        return False


def _drive_of(report: Path) -> Path:
    """The drive that a report names."""
    from sofjax.io.errors import InputError
    from sofjax.io.json_text import read_json

    try:
        return Path(read_json(report, "the report of the run")["drive"])
    except InputError as error:
        raise InputError(f"{error}; name the drive as a second argument") from None
    except (LookupError, TypeError):
        raise InputError(f"{report}: names no drive; give it as a second argument") from None
