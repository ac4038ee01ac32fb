"""`sofjax run`: a drive in, a trajectory and a map out."""

import argparse
import dataclasses
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from sofjax.cli import calibrate_robot, summaries
from sofjax.cli.progress import bar
from sofjax.pipeline import stopping

if TYPE_CHECKING:
    from sofjax.io.drive import Drive
    from sofjax.pipeline import RunSettings, RunWriter


def run(args: argparse.Namespace) -> int:
    """Read the drive, run it into a folder, print what came out."""
    _drive_behind_set(args)
    begun = time.perf_counter()

    from sofjax.io.drive import read_drive
    from sofjax.pipeline import open_run, run_drive
    from sofjax.vision import Frontend

    settings = settings_of(args)
    drive = read_drive(args.drive)
    frontend = Frontend.of(drive, settings.frontend)
    for contradiction in drive.contradictions:  # before it does harm
        print(f"sofjax: {contradiction}", file=sys.stderr)
    with open_run(args.out, drive, settings) as writer:
        if args.calibrate:
            fitted = _calibrate(drive, settings, writer)
            if fitted is None:
                return calibrate_robot.REFUSED
            drive = fitted
            frontend = Frontend(drive.camera_file, settings.frontend, bits=frontend.bits)
        with bar(len(drive.image_files), drive.name, "frame") as progress:
            result = run_drive(
                drive, settings, writer=writer, frontend=frontend, progress=progress, begun=begun
            )
        print(summaries.of_run(writer.folder, result))
        if writer.folder is not None and not result.stopped:
            print(summaries.after_run(writer.folder, drive))
        return stopping.exit_code() if result.stopped else 0


def settings_of(args: argparse.Namespace) -> "RunSettings":
    """The settings that the file, `--set` and the options of their own ask for.

    **Raises:** `InputError`, or a parser's error for a detector that is not registered.
    """
    from sofjax.pipeline.settings import gather
    from sofjax.vision import DETECTORS

    if args.detector is not None and args.detector not in DETECTORS:
        known = ", ".join(map(repr, DETECTORS))
        args.parser.error(
            f"argument --detector: invalid choice: {args.detector!r} (choose from {known})"
        )
    options = {
        "--particles": ("filter.particles", args.particles),
        "--seed": ("seed", args.seed),
        "--loop": ("loop", args.loop),
        "--detector": ("frontend.detector", args.detector),
    }
    return gather(args.config, args.sets, options)


def _calibrate(drive: "Drive", settings: "RunSettings", writer: "RunWriter") -> "Drive | None":
    """`--calibrate`: the drive with the rig that is fitted to it; None if it is not usable."""
    from sofjax import viewer
    from sofjax.pipeline import calibrate_drive, run_folder
    from sofjax.pipeline.calibrate import FRONTEND, IF_TOLD

    frontend = dataclasses.replace(settings.frontend, capacity=FRONTEND.capacity)
    with bar(len(drive.image_files), "segments") as progress:
        found = calibrate_drive(drive, frontend, progress=progress, more=IF_TOLD, robot=True)
    print(summaries.of_calibration(found))
    if not found.usable:
        print("the drive is not run: measure the mount, or leave --calibrate out")
    drawn = writer.write_calibration(found)
    if not viewer.available():
        print(viewer.MISSING)
    elif drawn and writer.folder is not None:
        print(f"drawn to {writer.folder / run_folder.MOUNT}")
    return found.calibrated_drive if found.usable else None


def _drive_behind_set(args: argparse.Namespace) -> None:
    """`--set a=1 DRIVE`: the option takes all the words that follow it, and so the drive too."""
    words = [word for word in args.sets if "=" not in word]
    if args.drive is None and len(words) == 1:
        args.drive = Path(words[0])
        args.sets.remove(words[0])
    if args.drive is None:
        args.parser.error("the following arguments are required: DRIVE")
