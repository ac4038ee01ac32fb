"""Trajectories in the TUM form: one row a pose, `timestamp tx ty tz qx qy qz qw`."""

import contextlib
import math
from array import array
from dataclasses import dataclass
from io import FileIO
from pathlib import Path

import numpy as np

from sofjax.io.errors import InputError, quoted
from sofjax.io.numbers import decimal
from sofjax.io.text import rows, write_atomically

COLUMNS = "timestamp tx ty tz qx qy qz qw"
HEAD = f"# T_world_robot: {COLUMNS}\n"
GAP = 2.5  # times the usual time from stamp to stamp, beyond which some are missing
LARGEST = 1e20  # nanoseconds of an epoch have 19 digits
MANY = 12  # lines that a sentence names


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


@dataclass(frozen=True)
class TrajectoryFile:
    """A trajectory, and how its file has it."""

    trajectory: Trajectory
    lines: np.ndarray  # [n] the line of each pose
    nanoseconds: bool  # whether the file's timestamps are nanoseconds, not seconds
    remarks: list[str]  # sentences on what was read differently from how it is written


def read_trajectory(path: Path, what: str = "a trajectory") -> Trajectory:
    """The poses of a TUM file, as `read_trajectory_file` reads them."""
    return read_trajectory_file(path, what).trajectory


def read_trajectory_file(path: Path, what: str) -> TrajectoryFile:
    """Read a TUM file of the robot's poses; heights and tilts are left out.

    Rows that stand there twice are dropped, with a remark, and nanoseconds become seconds.

    **Raises:** `InputError` that names the line for anything but rows of 8 finite numbers with
    increasing stamps, unit quaternions and the z axis up.
    """
    numbers, flat = array("q"), array("d")
    for number, line in rows(path, what):
        flat.extend(_pose(f"{path}, line {number}", line))
        numbers.append(number)
    if not numbers:
        raise InputError(f"{path}: no pose in it; {what} has a row '{COLUMNS}' for each pose")
    lines, table = np.array(numbers), np.array(flat).reshape(-1, 8)
    kept, remarks = in_order(path, lines, table[:, 0], table[:, 1:])
    stamps, x, y, _, qx, qy, qz, qw = table[kept].T
    nanoseconds = in_nanoseconds(stamps)
    if nanoseconds:
        stamps = 1e-9 * stamps
    yaw = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy**2 + qz**2))
    trajectory = Trajectory(stamps, np.stack([x, y], axis=-1), np.unwrap(yaw))
    return TrajectoryFile(trajectory, lines[kept], nanoseconds, remarks)


def in_order(
    path: Path, lines: np.ndarray, stamps: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, list[str]]:
    """Which rows to keep: of several with one stamp and one value the first.

    **Arguments:**
    - `lines`: [n], the line of each row.
    - `stamps`: [n].
    - `values`: [n, k], what each row says of its stamp.

    **Returns:** [n] bool, and remarks on what was dropped.

    **Raises:** `InputError` with all lines that say different things of one stamp, or with the
    line whose stamp runs back.
    """
    _, first, which = np.unique(stamps, return_index=True, return_inverse=True)
    before = first[which]  # the first row of the same stamp
    kept = before == np.arange(len(stamps))
    torn = ~kept & (values != values[before]).any(axis=1)
    if torn.any():
        several = np.unique(lines[np.append(np.flatnonzero(torn), before[torn])])
        few = ", ".join(map(str, several[:MANY]))
        few += f" and {len(several) - MANY} more" * (len(several) > MANY)
        raise InputError(
            f"{path}, lines {few}: a timestamp repeats with another value; each must stand there "
            "once"
        )
    times, at = stamps[kept], lines[kept]
    for i in np.flatnonzero(np.diff(times) < 0)[:1]:
        raise InputError(
            f"{path}, line {at[i + 1]}: the timestamp {times[i + 1]:.6f} runs back "
            f"behind {times[i]:.6f} of the row before; timestamps must increase"
        )
    if kept.all():
        return kept, []
    remark = f"{path.name}: {(~kept).sum()} rows repeat another and were dropped"
    return kept, [f"{remark}, line {lines[~kept][0]} first"]


def gaps(stamps: np.ndarray) -> list[tuple[float, float]]:
    """(begin, seconds) of the times from one stamp to the next that are far longer than usual."""
    steps = np.diff(stamps)
    if not len(steps):
        return []
    long = np.flatnonzero(steps > GAP * np.median(steps))
    return [(float(stamps[i]), float(steps[i])) for i in long]


def in_nanoseconds(stamps: np.ndarray) -> bool:
    """Whether stamps are nanoseconds: in seconds no log is so slow, or so old."""
    apart = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    return apart >= 1e5 or abs(float(stamps[0])) >= 1e15


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
        value = decimal(word)
    except ValueError:
        raise InputError(f"{where}: {quoted(word)} is not a number") from None
    if not abs(value) <= LARGEST:
        raise InputError(f"{where}: {quoted(word)} is not a finite number")
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

    The file is made with the first row. Where there is no space for a row, such as on a full disk,
    the file ends with the row before, and the `OSError` names the file.
    """

    def __init__(self, path: Path) -> None:
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
            with contextlib.suppress(OSError):  # only a regular file can be truncated
                self._file.truncate(self._size)  # a part of the row may have been written
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
