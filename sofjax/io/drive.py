"""A drive: a folder in the manner of the TUM data sets, with images, odometry and a camera."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sofjax.io.camera_file import CameraFile, read_camera
from sofjax.io.contradictions import contradictions
from sofjax.io.errors import InputError
from sofjax.io.image_list import read_images
from sofjax.io.numbers import MAX_SEGMENTS, check_segment
from sofjax.io.odometry import (
    CLOSE,
    Outage,
    extended,
    mend,
    unknown_motion,
    usual_speeds,
)
from sofjax.io.text import rows
from sofjax.io.trajectory import (
    Trajectory,
    TrajectoryFile,
    finite,
    read_trajectory_file,
)

MANY = 8  # warnings of one kind


@dataclass(frozen=True)
class Drive:
    """What a drive's folder holds, read and checked; the images themselves are read later."""

    path: Path
    name: str
    camera_file: CameraFile
    image_stamps: np.ndarray  # [T] float64, seconds, strictly increasing
    image_files: list[Path]  # [T], all inside the folder; a few may be missing
    odometry: Trajectory  # mended: without impossible rows
    outages: list[Outage]  # times over which the odometry does not give the motion
    contradictions: list[str]  # sentences: why the odometry cannot be as described
    remarks: list[str]  # sentences on what was read differently from how it is written
    groundtruth: Trajectory | None
    floor_segments: np.ndarray | None  # [S, 2, 2] float64, the true segments, world frame, metres

    @property
    def odometer_stamps(self) -> np.ndarray:
        """[T] The stamps of the images by the odometer's clock, seconds."""
        return self.image_stamps + self.camera_file.rig_fields.time_offset

    @property
    def odometry_at_images(self) -> Trajectory:
        """[T] The odometer's poses when the images were taken."""
        return self.odometry.at(self.odometer_stamps)


def read_drive(path: Path) -> Drive:
    """Read and check a drive's folder.

    **Raises:** `InputError` with the file, the line and what would be right.
    """
    path = check_folder(path)
    camera_file = read_camera(path / "camera.yaml")
    stamps, files, nanoseconds, remarks = read_images(path)
    read = read_odometry(path / "odometry.txt")
    truth = _read_true_path(path)
    counted = {"rgb.txt": nanoseconds, "odometry.txt": read.nanoseconds}
    remarks += read.remarks
    if truth:
        counted["groundtruth.txt"] = truth.nanoseconds
        remarks += truth.remarks
    _check_units(path, counted)
    if nanoseconds:
        remarks.append("the timestamps are nanoseconds, and were read as such")
    span = read.trajectory.span()
    stamps_odometer = stamps + camera_file.rig_fields.time_offset
    if outside(read.trajectory, stamps_odometer).all():
        raise InputError(
            f"{path}: the images ({stamps[0]:.3f} to {stamps[-1]:.3f} s) and the odometry "
            f"({span}) never meet; both need the timestamps of one clock, in seconds"
        )
    mended, outages = mend("odometry.txt", read.lines, read.trajectory)
    odometry, beyond = extended("odometry.txt", mended, stamps_odometer)
    return Drive(
        path=path,
        name=path.resolve().name,
        camera_file=camera_file,
        image_stamps=stamps,
        image_files=files,
        odometry=odometry,
        outages=outages + beyond,
        contradictions=contradictions("odometry.txt", read.lines, read.trajectory, mended),
        remarks=remarks,
        groundtruth=truth and truth.trajectory,
        floor_segments=_read_true_segments(path),
    )


def _check_units(path: Path, nanoseconds: dict[str, bool]) -> None:
    """Refuse stamps that are nanoseconds in some files and seconds in others."""
    if any(nanoseconds.values()) and not all(nanoseconds.values()):
        counted = [name for name, is_so in nanoseconds.items() if is_so]
        others = [name for name, is_so in nanoseconds.items() if not is_so]
        raise InputError(
            f"{path / counted[0]}: its timestamps are nanoseconds and those of "
            f"{' and '.join(others)} are not; all files of a drive must be in seconds, or all in "
            "nanoseconds"
        )


def check_folder(path: Path) -> Path:
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: there is no such drive; a drive is a folder with a camera.yaml")
    if not path.is_dir():
        raise InputError(f"{path}: a drive is a folder with a camera.yaml, and this is a file")
    return path


def read_truth(path: Path) -> tuple[Trajectory | None, np.ndarray | None]:
    """The true path and the true segments [S, 2, 2] of a drive's folder, where they are known."""
    poses = _read_true_path(path)
    return poses and poses.trajectory, _read_true_segments(path)


def _read_true_path(path: Path) -> TrajectoryFile | None:
    file = path / "groundtruth.txt"
    return read_trajectory_file(file, "the true path") if file.exists() else None


def _read_true_segments(path: Path) -> np.ndarray | None:
    file = path / "floor_segments.csv"
    return read_floor_segments(file) if file.exists() else None


def read_floor_segments(path: Path) -> np.ndarray:
    """True segments on the floor: rows `x1,y1,x2,y2,kind`, world frame, metres; [S, 2, 2]."""
    table = []
    for number, line in rows(path, "the table of true segments"):
        words = line.split(",")
        if len(words) < 4:
            raise InputError(
                f"{path}, line {number}: {len(words)} columns where there must be x1,y1,x2,y2,kind"
            )
        where = f"{path}, line {number}"
        ends = [finite(where, word.strip()) for word in words[:4]]
        check_segment(where, *ends)
        if len(table) == MAX_SEGMENTS:
            raise InputError(f"{where}: more than {MAX_SEGMENTS} segments are too many to compare")
        table.append(ends)
    if not table:
        raise InputError(f"{path}: no segment in it; without truth there must be no such file")
    return np.array(table).reshape(-1, 2, 2)


def motions(drive: Drive) -> np.ndarray:
    """The odometer's motion up to each image, T_previous_current as (dx, dy, dyaw); [T, 3].

    The odometry is interpolated at the stamps of the images. The first motion is the identity, and
    so is one between two images beyond the ends of the odometry.
    """
    at = drive.odometry_at_images
    dx, dy = np.diff(at.xy, axis=0).T
    c, s = np.cos(at.yaw[:-1]), np.sin(at.yaw[:-1])
    steps = np.stack([c * dx + s * dy, c * dy - s * dx, np.diff(at.yaw)], axis=-1)
    return np.concatenate([np.zeros((1, 3)), steps])


def ways_around(drive: Drive, lags: np.ndarray) -> np.ndarray:
    """The odometer's way from each image to some seconds after it, or before.

    **Arguments:**
    - `lags`: [L], seconds.

    **Returns:** [T, L, 3] twists (v_x, v_y, omega) over the lag, metres and radians; nothing moves
    beyond the ends of the odometry.
    """
    stamps = drive.odometer_stamps
    here, there = drive.odometry.at(stamps), drive.odometry.at(stamps[:, None] + lags)
    dx, dy = np.moveaxis(there.xy - here.xy[:, None], -1, 0)
    c, s = np.cos(here.yaw)[:, None], np.sin(here.yaw)[:, None]
    turn = there.yaw - here.yaw[:, None]
    x, y, half = c * dx + s * dy, c * dy - s * dx, turn / 2
    small = np.abs(half) < 1e-6
    a = np.where(small, 1.0, half / np.tan(np.where(small, 1.0, half)))  # the logarithm of SE(2)
    return np.stack([a * x + half * y, a * y - half * x, turn], axis=-1)


def motion_sigmas(drive: Drive) -> np.ndarray | None:
    """What is not known of the motion up to each image, beyond the odometer's noise.

    **Returns:** [T, 3] standard deviations (forward, sideways, turn), metres and radians, zero
    where the odometry gives the motion; None if it always does.
    """
    speeds = usual_speeds(drive.odometry)
    return unknown_motion(drive.outages, speeds, drive.odometer_stamps)


def odometry_warnings(drive: Drive) -> list[str]:
    """Sentences on where the odometry does not give the motion, each with the images in it."""
    found = []
    for outage in drive.outages[:MANY]:
        edges = np.clip(drive.odometer_stamps, outage.begin, outage.end)
        images = int((np.diff(edges) > 0).sum())
        between = "what lies between" if outage.bridged else "the motion there"
        found.append(f"{outage.sentence}; {between} is taken as unknown ({images} images)")
    if len(drive.outages) > MANY:
        found.append(f"odometry.txt: {len(drive.outages) - MANY} more such places")
    return found


def outside(odometry: Trajectory, stamps: np.ndarray) -> np.ndarray:
    """[T] bool, images over `CLOSE` seconds before the odometry begins or after it ends."""
    return (stamps < odometry.stamps[0] - CLOSE) | (stamps > odometry.stamps[-1] + CLOSE)


def read_odometry(path: Path) -> TrajectoryFile:
    """The odometry as its file has it, of two poses or more; `mend` makes it a path."""
    if not path.exists():
        raise InputError(
            f"{path}: the wheel odometry is missing, and without it neither the motion nor the "
            "scale is known; it must have a row 'timestamp tx ty tz qx qy qz qw' for each pose"
        )
    odometry = read_trajectory_file(path, "the odometry")
    if len(odometry.lines) < 2:
        raise InputError(f"{path}: one pose alone tells no motion; there must be two or more")
    return odometry
