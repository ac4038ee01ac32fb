"""Trajectories in the TUM form: one row a pose, `timestamp tx ty tz qx qy qz qw`."""

import contextlib
import math
from dataclasses import dataclass
from io import FileIO
from pathlib import Path

import numpy as np

from sofjax.io.errors import InputError
from sofjax.io.text import rows, write_atomically

COLUMNS = "timestamp tx ty tz qx qy qz qw"
HEAD = f"# T_world_robot: {COLUMNS}\n"


@dataclass(frozen=True)
class Trajectory:
    """Poses of the robot on the floor, `T_world_robot` at each stamp; at least one."""

    stamps: np.ndarray  # [n] float64, seconds, strictly increasing
    xy: np.ndarray  # [n, 2] float64, metres
    yaw: np.ndarray  # [n] float64, radians, unwrapped

    def at(self, stamps: np.ndarray) -> "Trajectory":
        """The poses at other stamps, linear in between; beyond the ends, the first and last."""
        x, y, yaw = (np.interp(stamps, self.stamps, v) for v in (*self.xy.T, self.yaw))
        return Trajectory(np.asarray(stamps, float), np.stack([x, y], axis=-1), yaw)

    @property
    def travelled(self) -> np.ndarray:
        """[n] length of the path up to each pose, metres."""
        return np.append(0.0, np.cumsum(np.hypot(*np.diff(self.xy, axis=0).T)))

    def span(self) -> str:
        return f"{self.stamps[0]:.3f} to {self.stamps[-1]:.3f} s"


def read_trajectory(path: Path, what: str = "a trajectory") -> Trajectory:
    """Read a TUM file of the robot's poses; heights and tilts are left out.

    **Raises:** `InputError` that names the line for anything but rows of 8 finite numbers with
    increasing stamps, unit quaternions and the z axis up.
    """
    numbers, table = [], []
    for number, line in rows(path, what):
        table.append(_pose(f"{path}, line {number}", line))
        numbers.append(number)
    if not table:
        raise InputError(f"{path}: no pose in it; {what} has a row '{COLUMNS}' for each pose")
    stamps, x, y, _, qx, qy, qz, qw = np.array(table).T
    check_increasing(path, numbers, stamps)
    yaw = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy**2 + qz**2))
    return Trajectory(stamps, np.stack([x, y], axis=-1), np.unwrap(yaw))


def check_increasing(path: Path, numbers: list[int], stamps: np.ndarray) -> None:
    """Refuse stamps that repeat or run backwards, by the number of the line."""
    for i in np.flatnonzero(np.diff(stamps) <= 0)[:1]:
        fault = "repeats" if stamps[i + 1] == stamps[i] else "runs back behind"
        raise InputError(
            f"{path}, line {numbers[i + 1]}: the timestamp {stamps[i + 1]:.6f} {fault} "
            f"{stamps[i]:.6f} of the row before; timestamps must increase"
        )


def _pose(where: str, line: str) -> list[float]:
    words = line.split()
    if len(words) != 8:
        raise InputError(f"{where}: {len(words)} columns where there must be 8, '{COLUMNS}'")
    pose = [finite(where, word) for word in words]
    qx, qy, qz, qw = pose[4:]
    norm = math.hypot(qx, qy, qz, qw)
    if abs(norm - 1) > 0.02:
        raise InputError(
            f"{where}: the quaternion qx qy qz qw has length {norm:.3f} and must have length 1"
        )
    if 1 - 2 * (qx**2 + qy**2) < 0.5:
        raise InputError(
            f"{where}: the z axis is tilted by more than 60 degrees; poses must be those of the "
            "robot on the floor, x forward and z up, not of the camera"
        )
    return pose[:4] + [q / norm for q in pose[4:]]


def finite(where: str, word: str) -> float:
    """A number of a table, or the sentence that says why it is none."""
    try:
        value = float(word)
    except ValueError:
        raise InputError(f"{where}: '{word[:40]}' is not a number") from None
    if not math.isfinite(value):
        raise InputError(f"{where}: '{word}' is not a finite number")
    return value


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """All rows at once, and the file whole or not at all."""
    poses = zip(trajectory.stamps, trajectory.xy, trajectory.yaw, strict=True)
    write_atomically(path, HEAD + "".join(_row(*pose) for pose in poses))


def _row(stamp: float, xy: np.ndarray, yaw: float) -> str:
    qz, qw = math.sin(yaw / 2), math.cos(yaw / 2)
    return f"{stamp:.6f} {xy[0]:.6f} {xy[1]:.6f} 0 0 0 {qz:.9f} {qw:.9f}\n"


class TrajectoryWriter:
    """Writes rows as they come, each one complete on the disk before the next.

    The file is made with the first row. Where there is no room for a row, such as on a full disk,
    the file ends with the row before, and the `OSError` names the file.
    """

    def __init__(self, path: Path):
        self._path, self._size = path, 0
        self._file: FileIO | None = None

    def write(self, stamp: float, xy: np.ndarray, yaw: float) -> None:
        """One pose: seconds, metres, radians."""
        row = _row(stamp, xy, yaw)
        if self._file is None:
            self._file, row = open(self._path, "wb", buffering=0), HEAD + row
        left = data = row.encode()
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError as error:
            with contextlib.suppress(OSError):  # what is no regular file cannot be cut
                self._file.truncate(self._size)  # a part of the row may have had room
            error.filename = str(self._path)
            raise
        self._size += len(data)

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def __enter__(self) -> "TrajectoryWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
