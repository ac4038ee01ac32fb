"""`sofjax evaluate`: a run against the truth."""

import argparse

from sofjax.cli.summaries import errors_table


def run(args: argparse.Namespace) -> int:
    """Compare, and print the errors."""
    from sofjax.pipeline import evaluate_run

    found = evaluate_run(args.folder, args.drive)
    print(f"{args.folder} of {found.name}: {found.trajectory.path_m:.1f} m")
    print("\n".join(errors_table(found.trajectory, found.smoothed, found.odometry, found.map)))
    if found.map is None:
        print("    the map is not compared: its file or floor_segments.csv is missing")
    return 0
