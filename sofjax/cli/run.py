"""`sofjax run`: a drive in, a trajectory and a map out."""

import argparse
import dataclasses
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from sofjax.cli import stopping

if TYPE_CHECKING:
    from sofjax.extraction.observation import Observation
    from sofjax.io.drive import Drive
    from sofjax.pipeline.settings import RunSettings
    from sofjax.slam.state import SlamState, StepInfo
    from sofjax.vision import Frontend, View

LOOPS = ("none", "paper", "smooth")
AHEAD = 8  # images that are searched for segments before the filter asks for them


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "run",
        help="estimate the trajectory and the map of a drive",
        description="Estimate the trajectory and the map of floor segments of a drive.",
        usage="sofjax run DRIVE [--out DIR] [--particles N] [--seed S] [--detector hough|lsd] "
        "[--calibrate] [--loop none|paper|smooth] [--config FILE] [--set name=value ...]",
    )
    parser.add_argument("drive", metavar="DRIVE", nargs="?", type=Path, help="folder of the drive")
    parser.add_argument("--out", metavar="DIR", type=Path, help="default: runs/<drive>-<time>/")
    parser.add_argument("--particles", metavar="N", type=int, help="size of the filter")
    parser.add_argument("--seed", metavar="S", type=int, help="of the random numbers; default 0")
    parser.add_argument("--detector", choices=("hough", "lsd"), help="of the segments in an image")
    parser.add_argument(
        "--calibrate",
        action="store_true",
        help="first fit the camera's height, pitch and roll to the drive, and run with them",
    )
    parser.add_argument(
        "--loop",
        choices=LOOPS,
        help="after the drive: nothing, the paper's closing, or all poses and lines solved at once",
    )
    parser.add_argument("--config", metavar="FILE", type=Path, help="settings as TOML")
    parser.add_argument(
        "--set",
        metavar="name=value",
        dest="sets",
        nargs="+",
        action="extend",
        default=[],
        help="change settings, such as motion.distance_noise=0.02 or preset=paper",
    )
    parser.set_defaults(run=run, parser=parser)


def run(args: argparse.Namespace) -> int:
    """Read the drive, run it into a folder."""
    _drive_behind_set(args)
    begun = time.perf_counter()

    from sofjax.cli import calibrate_mount
    from sofjax.io.drive import read_drive
    from sofjax.io.settings import to_dict, to_toml
    from sofjax.io.text import write_atomically
    from sofjax.pipeline import run_folder
    from sofjax.pipeline.settings import gather
    from sofjax.vision import Frontend

    settings = gather(args)
    drive = read_drive(args.drive)
    frontend = Frontend.of(drive, settings.frontend)
    drive = dataclasses.replace(drive, remarks=drive.remarks + frontend.remarks)
    for contradiction in drive.contradictions:  # before it does harm
        print(f"sofjax: {contradiction}", file=sys.stderr)
    with run_folder.run_folder(args.out, drive.name, drive.path) as folder:
        write_atomically(folder / run_folder.CONFIG, to_toml(to_dict(settings)))
        mount = None
        if args.calibrate:
            fitted = calibrate_mount.fit_before_run(drive, settings.frontend, folder)
            if not fitted.usable:
                return calibrate_mount.REFUSED
            drive = dataclasses.replace(drive, camera_file=fitted.camera_file)
            frontend = Frontend(drive.camera_file, settings.frontend, bits=frontend.bits)
            mount = fitted.numbers
        return _run_into(folder, drive, frontend, settings, mount, begun)


def _run_into(
    folder: Path,
    drive: "Drive",
    frontend: "Frontend",
    settings: "RunSettings",
    mount: dict[str, object] | None,
    begun: float,
) -> int:
    """Drive and write; then solve, write again, and draw.

    What was driven stands on the disk before anything is solved for. Whatever ends the run, what
    is there can be read, and the report tells how far it came. Ctrl-C ends the drive or the
    solving, and what was done until then is written.

    **Arguments:**
    - `mount`: what `--calibrate` found, if it was asked for.
    - `begun`: the clock when the command began.
    """
    from sofjax.pipeline import results as report
    from sofjax.pipeline.run_log import RunLog

    run_log, seconds, closed, lapped = RunLog(), {}, None, begun

    def lap(name: str) -> None:
        nonlocal lapped
        now = time.perf_counter()
        seconds[name], lapped = seconds.get(name, 0.0) + now - lapped, now

    def write(loop: str | None) -> report.Results:
        results = report.write_results(folder, drive, run_log, state, driven, closed, bool(early))
        report.add_loop(settings.loop, loop)
        report.write_report(folder, drive, settings, run_log, results, seconds, mount)
        lap("write")
        return results

    lap("start")
    with stopping.held():
        state, early = _drive(folder, drive, frontend, settings, run_log)
        lap("drive")
        run_log.doubts = report.doubts_of(drive, settings, run_log)
        driven = report.driven_map(drive, settings, state)
        loop = None
        if settings.loop != "none":
            loop = report.INTERRUPTED if early else report.UNFINISHED
        try:
            results = write(loop)
        finally:
            if isinstance(early, OSError):  # there was no room for a pose, and so for what follows
                raise early
        if loop == report.UNFINISHED:
            try:
                with stopping.allowed():
                    from sofjax.pipeline.finalize import close  # with optimistix, slow to import

                    closed = close(drive, settings, run_log, state, driven)
                loop = report.SOLVED if closed else report.NOTHING
            except KeyboardInterrupt:
                loop = report.INTERRUPTED
            lap("loop")
            results = write(loop)
        with stopping.allowed():
            report.draw_figure(folder, drive, run_log, results)
        lap("write")
        report.write_report(folder, drive, settings, run_log, results, seconds, mount)
    print(report.summary(folder, drive, run_log, results, seconds))
    return stopping.exit_code() if early or loop == report.INTERRUPTED else 0


def _drive(
    folder: Path, drive: "Drive", frontend: "Frontend", settings: "RunSettings", run_log: "Tally"
) -> tuple["SlamState | None", KeyboardInterrupt | OSError | None]:
    """Take image after image, and write each one's pose.

    **Returns:** the last state, and what ended the drive early: Ctrl-C or a full disk.
    """
    from tqdm import tqdm

    from sofjax.io.trajectory import TrajectoryWriter
    from sofjax.pipeline import run_folder

    state, coming = None, steps(settings, drive, frontend)
    bar = tqdm(total=len(drive.image_files), desc=drive.name, unit="frame", disable=None)
    with bar, TrajectoryWriter(folder / run_folder.TRAJECTORY) as writer:
        while True:
            try:
                with stopping.allowed():
                    done = next(coming, None)
            except KeyboardInterrupt as interrupt:
                return state, interrupt
            if done is None:
                return state, None
            view, observed, info, seconds, state = done
            run_log.add(drive, view, observed, info, seconds, time.perf_counter())
            try:
                writer.write(run_log.stamps[-1], run_log.poses[-1][:2], run_log.poses[-1][2])
            except OSError as error:
                return state, error
            bar.update()
            if len(run_log.stamps) == 1:
                bar.unpause()  # compiling is no part of the frames a second


def steps(
    settings: "RunSettings", drive: "Drive", frontend: "Frontend"
) -> Iterator[tuple["View", "Observation", "StepInfo", dict[str, float], "SlamState"]]:
    """Fig. 6 for one image after the other, with the seconds that each waited and computed."""
    import jax

    from sofjax.slam import SofSlam
    from sofjax.vision import observations

    slam = SofSlam(settings.slam, drive.camera_file.camera, drive.camera_file.mount)
    state = slam.init(jax.random.key(settings.seed), settings.frontend.capacity)
    with closing(views(frontend, drive.image_files)) as coming:
        begun = time.perf_counter()
        for view, observed in observations(drive, coming):
            waited = time.perf_counter()
            state, info = slam.step(state, observed)
            info = jax.device_get(info)
            stepped = time.perf_counter()
            yield view, observed, info, {"wait": waited - begun, "step": stepped - waited}, state
            begun = time.perf_counter()


def views(frontend: "Frontend", files: list[Path]) -> Iterator["View"]:
    """The views of the images in order, made ahead of time by a thread of their own."""
    worker = ThreadPoolExecutor(max_workers=1)
    try:
        coming = [worker.submit(frontend.view, file) for file in files[:AHEAD]]
        for i in range(len(files)):
            view = coming.pop(0).result()
            if i + AHEAD < len(files):
                coming.append(worker.submit(frontend.view, files[i + AHEAD]))
            yield view
    finally:
        worker.shutdown(cancel_futures=True)


def _drive_behind_set(args: argparse.Namespace) -> None:
    """`--set a=1 DRIVE`: the option takes all the words that follow it, and so the drive too."""
    words = [word for word in args.sets if "=" not in word]
    if args.drive is None and len(words) == 1:
        args.drive = Path(words[0])
        args.sets.remove(words[0])
    if args.drive is None:
        args.parser.error("the following arguments are required: DRIVE")
