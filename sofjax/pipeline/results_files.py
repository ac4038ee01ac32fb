"""The files of a run, written as they come."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sofjax import viewer
from sofjax.io.drive import Drive
from sofjax.io.map_file import write_map
from sofjax.io.settings import to_dict, to_toml
from sofjax.io.text import write_atomically
from sofjax.io.trajectory import TrajectoryWriter, write_trajectory
from sofjax.pipeline import figures, run_folder
from sofjax.pipeline.report import report_of
from sofjax.pipeline.results import DriveResult
from sofjax.pipeline.settings import RunSettings

if TYPE_CHECKING:
    from sofjax.pipeline.calibrate import Calibration  # with optimistix, slow to import

WritePose = Callable[[float, np.ndarray], None]  # of a stamp and (x, y, yaw), metres and radians


@contextlib.contextmanager
def open_run(out: Path | None, drive: Drive, settings: RunSettings) -> "Iterator[RunWriter]":
    """The writer of a new run, whose folder is locked for it; the settings stand there at once.

    **Arguments:**
    - `out`: the folder; None for a new one under `runs/`.

    **Raises:** `InputError` if it cannot be this run's; see `run_folder.run_folder`.
    """
    with run_folder.run_folder(out, drive.name, drive.path) as folder:
        write_atomically(folder / run_folder.CONFIG, to_toml(to_dict(settings)))
        yield RunWriter(folder)


class RunWriter:
    """Writes into the folder of a run what `run_drive` hands to it; without a folder, nothing."""

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder
        self.calibration: dict[str, object] | None = None  # for the report

    @property
    def remarks(self) -> list[str]:
        """Sentences on what cannot be written here."""
        return [] if self.folder is None or viewer.available() else [viewer.MISSING]

    @contextlib.contextmanager
    def poses(self) -> Iterator[WritePose]:
        """Within the block, each pose is on the disk before the next.

        The `OSError` of a full disk names the file, which ends with the pose before.
        """
        if self.folder is None:
            yield lambda stamp, pose: None
            return
        with TrajectoryWriter(self.folder / run_folder.TRAJECTORY) as writer:
            yield lambda stamp, pose: writer.write(stamp, pose[:2], pose[2])

    def write_calibration(self, found: "Calibration") -> bool:
        """The camera's file if the mount is usable, and the figure.

        **Returns:** whether there is a figure.
        """
        assert self.folder is not None
        self.calibration = found.numbers
        if found.usable:
            found.write(self.folder / run_folder.CAMERA)
        return figures.draw_calibration(self.folder / run_folder.MOUNT, found)

    def write_results(self, result: DriveResult) -> None:
        """The map, and before it the path that it goes with if it was solved after the drive."""
        if self.folder is None:
            return
        if result.closed is not None:
            write_trajectory(self.folder / run_folder.SMOOTHED, result.closed.trajectory)
        of_map = result.map
        write_map(self.folder / run_folder.MAP, of_map.segments, of_map.measurements, of_map.height)

    def write_report(self, result: DriveResult, seconds: dict[str, float]) -> None:
        """`report.json`; `seconds` are those of each stage."""
        if self.folder is None:
            return
        digest = run_folder.digest(self.folder / run_folder.MAP)
        report = report_of(result, seconds, self.calibration, digest)
        run_folder.write_json(self.folder / run_folder.REPORT, report)

    def draw_figure(self, result: DriveResult) -> None:
        """The path and the map; there is no figure without an image or without matplotlib."""
        if self.folder is not None:
            figures.draw_result(self.folder / run_folder.FIGURE, result)
