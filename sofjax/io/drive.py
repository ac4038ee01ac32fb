"""A drive: a folder in the manner of the TUM data sets, with images, odometry and a camera."""

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from sofjax.io.camera_file import CameraFile, read_camera
from sofjax.io.errors import InputError
from sofjax.io.text import rows
from sofjax.io.trajectory import Trajectory, check_increasing, finite, read_trajectory

CLOSE = 0.2  # seconds that the odometry may start late or end early without a word


@dataclass(frozen=True)
class Drive:
    """What a drive's folder holds, read and checked; the images themselves are read later."""

    path: Path
    name: str
    camera_file: CameraFile
    image_stamps: np.ndarray  # [T] float64, seconds, strictly increasing
    image_files: list[Path]  # [T], all inside the folder; a few may be missing
    odometry: Trajectory
    groundtruth: Trajectory | None
    floor_segments: np.ndarray | None  # [S, 2, 2] float64, the true segments, world frame, metres


def read_drive(path: Path) -> Drive:
    """Read and check a drive's folder.

    **Raises:** `InputError` with the file, the line and what would be right.
    """
    path = check_folder(path)
    camera_file = read_camera(path / "camera.yaml")
    stamps, files = _read_images(path)
    odometry = _read_odometry(path / "odometry.txt")
    if outside(odometry, stamps).all():
        raise InputError(
            f"{path}: the images ({stamps[0]:.3f} to {stamps[-1]:.3f} s) and the odometry "
            f"({odometry.span()}) never meet; both need the timestamps of one clock, in seconds"
        )
    groundtruth, floor_segments = read_truth(path)
    return Drive(
        path=path,
        name=path.resolve().name,
        camera_file=camera_file,
        image_stamps=stamps,
        image_files=files,
        odometry=odometry,
        groundtruth=groundtruth,
        floor_segments=floor_segments,
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
    poses, segments = path / "groundtruth.txt", path / "floor_segments.csv"
    return (
        read_trajectory(poses, "the true path") if poses.exists() else None,
        read_floor_segments(segments) if segments.exists() else None,
    )


def read_floor_segments(path: Path) -> np.ndarray:
    """True segments on the floor: rows `x1,y1,x2,y2,kind`, world frame, metres; [S, 2, 2]."""
    table = []
    for number, line in rows(path, "the table of true segments"):
        words = line.split(",")
        if len(words) < 4:
            raise InputError(
                f"{path}, line {number}: {len(words)} columns where there must be x1,y1,x2,y2,kind"
            )
        table.append([finite(f"{path}, line {number}", word) for word in words[:4]])
    if not table:
        raise InputError(f"{path}: no segment in it; without truth there must be no such file")
    return np.array(table).reshape(-1, 2, 2)


def motions(drive: Drive) -> np.ndarray:
    """The odometer's motion up to each image, T_previous_current as (dx, dy, dyaw); [T, 3].

    The odometry is interpolated at the stamps of the images. The first motion is the identity,
    and so is one between two images that both lie outside the odometry's span.
    """
    at = drive.odometry.at(drive.image_stamps)
    dx, dy = np.diff(at.xy, axis=0).T
    c, s = np.cos(at.yaw[:-1]), np.sin(at.yaw[:-1])
    steps = np.stack([c * dx + s * dy, c * dy - s * dx, np.diff(at.yaw)], axis=-1)
    return np.concatenate([np.zeros((1, 3)), steps])


def outside(odometry: Trajectory, stamps: np.ndarray) -> np.ndarray:
    """[T] bool, images over `CLOSE` seconds before the odometry begins or after it ends."""
    return (stamps < odometry.stamps[0] - CLOSE) | (stamps > odometry.stamps[-1] + CLOSE)


def _read_odometry(path: Path) -> Trajectory:
    if not path.exists():
        raise InputError(
            f"{path}: the wheel odometry is missing, and without it neither the motion nor the "
            "scale is known; it must have a row 'timestamp tx ty tz qx qy qz qw' for each pose"
        )
    odometry = read_trajectory(path, "the odometry")
    if len(odometry.stamps) < 2:
        raise InputError(f"{path}: one pose alone tells no motion; there must be two or more")
    return odometry


def _read_images(path: Path) -> tuple[np.ndarray, list[Path]]:
    table = path / "rgb.txt"
    root = path.resolve()
    numbers, stamps, files = [], [], []
    for number, line in rows(table, "the list of images"):
        where = f"{table}, line {number}"
        words = line.split(maxsplit=1)
        if len(words) != 2:
            raise InputError(f"{where}: there must be two columns, 'timestamp file'")
        numbers.append(number)
        stamps.append(finite(where, words[0]))
        files.append(_inside(where, path, root, words[1]))
    if not files:
        raise InputError(f"{table}: no image in it; there must be a row 'timestamp file' for each")
    check_increasing(table, numbers, np.array(stamps))
    missing = [file for file in files if not file.is_file()]
    if 2 * len(missing) > len(files):
        raise InputError(
            f"{table}: {len(missing)} of its {len(files)} images are missing, {missing[0]} first; "
            "the files must lie where the list says"
        )
    return np.array(stamps), files


def _inside(where: str, path: Path, root: Path, name: str) -> Path:
    """The image's path, refused if it leaves the drive's folder in any way."""
    plain = PurePosixPath(name)
    odd = "\0" in name or max(map(len, plain.parts)) > 200
    if odd or plain.is_absolute() or ".." in plain.parts:
        right = "must be a path inside the drive's folder"
        raise InputError(f"{where}: the image {name!r:.120} {right}")
    file = path / plain
    try:
        inside = file.resolve().is_relative_to(root)
    except (OSError, RuntimeError):  # a ring of links
        inside = False
    if not inside:
        raise InputError(f"{where}: {name} is a link that leads out of the drive's folder")
    return file
