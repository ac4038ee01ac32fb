"""`inspect_drive`: what is in a drive, and whether a run on it can be right."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from sofjax.extraction.observation import Observation
from sofjax.extraction.sof import extract_along
from sofjax.io.drive import Drive
from sofjax.pipeline import setup_checks
from sofjax.pipeline.outcomes import DriveVerdict
from sofjax.pipeline.progress import Progress, watched
from sofjax.slam.presets import PRESETS
from sofjax.vision import Frontend, observations


@dataclass(frozen=True)
class Seen:
    """What the images of a drive show, by the odometer's motion alone."""

    log: Observation  # [T]
    faults: dict[str, list[Path]]  # images that tell nothing, by why
    usable: list[bool]  # [T] the others
    segments: int
    on_floor_side: np.ndarray  # [T, M] bool
    is_floor: np.ndarray  # [T, M] bool, of these, by eq. (9)

    @property
    def below_horizon(self) -> int:
        """Segments on the floor's side of the horizon."""
        return int(self.on_floor_side.sum())

    @property
    def associated(self) -> int:
        """Segments of these that move as the floor does."""
        return int(self.is_floor.sum())


@dataclass(frozen=True)
class Inspection:
    """What is in a drive."""

    drive: Drive
    frontend: Frontend
    seen: Seen
    warnings: list[str]  # sentences on what is odd
    contradictions: list[str]  # those of them that say that a run would mislead

    @property
    def verdict(self) -> DriveVerdict:
        if self.contradictions:
            return DriveVerdict.DOUBTFUL
        return DriveVerdict.USABLE if self.warnings else DriveVerdict.GOOD


def inspect_drive(
    drive: Drive, frontend: Frontend | None = None, progress: Progress | None = None
) -> Inspection:
    """What is in a drive and what its images say against the set-up.

    **Arguments:**
    - `frontend`: for the images of this drive; the default one if None.
    - `progress`: called after each image.

    **Raises:** `InputError` if no image can be used.
    """
    frontend = frontend or Frontend.of(drive)
    seen = _search(drive, frontend, progress)
    drive = dataclasses.replace(drive, remarks=drive.remarks + frontend.remarks)
    warnings = setup_checks.of_drive(drive)
    warnings += [f"{len(files)} images {fault}" for fault, files in seen.faults.items()]
    wrong = drive.contradictions + setup_checks.set_up(PRESETS["default"], drive, seen.log)
    warnings += [doubt for doubt in wrong if doubt not in warnings]
    return Inspection(drive, frontend, seen, warnings, wrong)


def _search(drive: Drive, frontend: Frontend, progress: Progress | None) -> Seen:
    """All images searched for segments, and SoF extracted along the odometry."""
    files = watched(drive.image_files, progress)
    faults: dict[str, list[Path]] = {}
    usable, segments, log = [], 0, []
    for i, (view, observed) in enumerate(observations(drive, map(frontend.view, files))):
        if view.fault:
            faults.setdefault(view.fault, []).append(drive.image_files[i])
        usable.append(view.readable)
        segments += view.detected
        log.append(observed)
    log = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *log)
    file = drive.camera_file
    config = PRESETS["default"].in_metres(file.camera, file.mount)
    found, _ = extract_along(
        config.association, file.camera, file.mount, log, config.filter.max_depth
    )
    on_floor_side, is_floor = map(np.asarray, (found.segments_robot.valid, found.is_floor))
    return Seen(log, faults, usable, segments, on_floor_side, is_floor)
