"""`run_drive`: a drive in, its trajectory and its map out."""

import dataclasses
import time

from sofjax.io.drive import Drive
from sofjax.pipeline import online, results, stopping
from sofjax.pipeline.outcomes import LoopStatus
from sofjax.pipeline.progress import Progress
from sofjax.pipeline.results import DriveResult
from sofjax.pipeline.results_files import RunWriter
from sofjax.pipeline.run_log import RunLog
from sofjax.pipeline.settings import RunSettings
from sofjax.pipeline.stages import Closed, Driven
from sofjax.slam.state import SlamState
from sofjax.vision import Frontend

DEFAULT = RunSettings()


def run_drive(
    drive: Drive,
    settings: RunSettings = DEFAULT,
    *,
    writer: RunWriter | None = None,
    frontend: Frontend | None = None,
    progress: Progress | None = None,
    begun: float | None = None,
) -> DriveResult:
    """The trajectory and the map of a drive, and what is to be said about them.

    Ctrl-C ends the drive or the solving after it; the result is then of what was done until then,
    and says so. What was driven is written before anything is solved for, so that whatever ends
    the process, the files that are there can be read.

    **Arguments:**
    - `writer`: of `open_run`, if the results are to be written to a folder as they come.
    - `frontend`: for the images of this drive; made of the settings by default.
    - `progress`: called after each image.
    - `begun`: `time.perf_counter()` when the work began, such as reading the drive.

    **Raises:** `InputError` if no image can be used or an estimate is not finite; `OSError` if a
    file cannot be written.
    """
    writer, clock = writer or RunWriter(), _Stopwatch(begun)
    settings = settings.used.on(drive.camera_file)
    frontend = frontend or Frontend.of(drive, settings.frontend)
    drive = dataclasses.replace(drive, remarks=drive.remarks + frontend.remarks)
    clock.lap("start")
    with stopping.held():
        driven = _drive(drive, settings, frontend, writer, progress, clock)
        status = None
        if settings.loop != "none":
            status = LoopStatus.INTERRUPTED if driven.interrupted else LoopStatus.UNFINISHED
        try:
            result = _write(driven, None, status, writer, clock)
        finally:
            if isinstance(driven.ended_by, OSError):  # no room for a pose, nor for what follows
                raise driven.ended_by
        if status == LoopStatus.UNFINISHED:
            closed, status = _close(driven)
            clock.lap("loop")
            result = _write(driven, closed, status, writer, clock)
        with stopping.allowed():
            writer.draw_figure(result)
        clock.lap("write")
        writer.write_report(result, clock.seconds)
    return dataclasses.replace(result, seconds=clock.seconds)


class _Stopwatch:
    """The seconds that each stage took."""

    def __init__(self, begun: float | None) -> None:
        self.seconds: dict[str, float] = {}
        self._lapped = time.perf_counter() if begun is None else begun

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._lapped
        self._lapped = now


def _drive(
    drive: Drive,
    settings: RunSettings,
    frontend: Frontend,
    writer: RunWriter,
    progress: Progress | None,
    clock: _Stopwatch,
) -> Driven:
    """The filter over all images, and its map."""
    run_log = RunLog()
    state, ended_by = _take_images(drive, settings, frontend, run_log, writer, progress)
    clock.lap("drive")
    run_log.doubts = results.doubts_of(drive, settings, run_log)
    final = results.driven_map(drive, settings, state)
    return Driven(drive, settings, run_log, state, final, ended_by)


def _take_images(
    drive: Drive,
    settings: RunSettings,
    frontend: Frontend,
    run_log: RunLog,
    writer: RunWriter,
    progress: Progress | None,
) -> tuple[SlamState | None, KeyboardInterrupt | OSError | None]:
    """Take image after image, and write each one's pose.

    **Returns:** the last state, and what ended the drive early: Ctrl-C or a full disk.
    """
    state, coming = None, online.steps(settings, drive, frontend)
    with writer.poses() as write_pose:
        while True:
            try:
                with stopping.allowed():
                    frame = next(coming, None)
            except KeyboardInterrupt as interrupt:
                return state, interrupt
            if frame is None:
                return state, None
            state = frame.state
            run_log.add(drive, frame, time.perf_counter())
            try:
                write_pose(run_log.stamps[-1], run_log.poses[-1])
            except OSError as error:
                return state, error
            if progress is not None:
                progress(len(run_log.stamps), len(drive.image_files))


def _close(driven: Driven) -> tuple[Closed | None, LoopStatus]:
    """What is solved after the drive, and how far that came."""
    try:
        with stopping.allowed():
            from sofjax.pipeline import finalize  # with optimistix, slow to import

            closed = finalize.close(driven)
    except KeyboardInterrupt:
        return None, LoopStatus.INTERRUPTED
    return closed, LoopStatus.SOLVED if closed else LoopStatus.NOTHING


def _write(
    driven: Driven,
    closed: Closed | None,
    status: LoopStatus | None,
    writer: RunWriter,
    clock: _Stopwatch,
) -> DriveResult:
    """The results as they are now, found and written."""
    result = results.find_results(driven, closed, status, writer.remarks)
    writer.write_results(result)
    writer.write_report(result, clock.seconds)
    clock.lap("write")
    return result
