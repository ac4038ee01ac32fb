"""What commands write, and where: nothing of the user's is replaced or removed."""

import contextlib
import fcntl
import hashlib
import json
import math
import os
import re
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from sofjax.io.errors import InputError
from sofjax.io.text import PART, write_atomically

TRAJECTORY, SMOOTHED = "trajectory.txt", "trajectory_smoothed.txt"
MAP, FIGURE = "map.geojson", "map.png"
REPORT, CONFIG = "report.json", "config.toml"
CAMERA, MOUNT = "camera.yaml", "mount.png"  # of `run --calibrate`
OF_A_RUN = (TRAJECTORY, SMOOTHED, MAP, FIGURE, CONFIG, CAMERA, MOUNT, REPORT)
MARKER = ".sofjax-run"  # names the files of a run, with their digests; locked while it goes on
HEAD = "# sofjax run, process "


@contextlib.contextmanager
def run_folder(out: Path | None, name: str, drive: Path) -> Iterator[Path]:
    """The folder for a run's results, for this run alone; what an earlier run left is removed.

    **Arguments:**
    - `out`: as the user gives it; None for a new one under `runs/` that is called after `name`.
    - `drive`: the folder of the drive.

    **Raises:** `InputError` if it cannot be written to, overlaps with the drive, belongs to a run
    that has not ended, or has a file by the name of a run's that no run has written there.
    """
    folder = _make(out, name, drive)
    try:
        marker = open(folder / MARKER, "a+", encoding="utf-8", buffering=1)
    except OSError as error:
        raise _unwritable(folder, error) from None
    with marker:
        _lock(marker, folder)
        _remove_earlier(marker, folder)
        marker.truncate(0)
        marker.write(f"{HEAD}{os.getpid()}\n" + "".join(f"{name}\n" for name in OF_A_RUN))
        try:
            yield folder
        finally:
            files = [folder / name for name in OF_A_RUN if (folder / name).exists()]
            with contextlib.suppress(OSError):  # without digests they are the run's by their names
                marker.write("".join(f"{path.name} {digest(path)}\n" for path in files))


def _make(out: Path | None, name: str, drive: Path) -> Path:
    """The folder that is given, or a new one; two runs that begin in one second get two."""
    usual = Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    folder, number = out or usual, 1
    here, there = (Path(os.path.realpath(path)) for path in (folder, drive))
    if here == there or here in there.parents or there in here.parents:
        raise InputError(
            f"{folder}: the results cannot be written into the drive {drive}, nor around it; give "
            "another folder with --out"
        )
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=out is not None)
            return folder
        except OSError as error:
            if out is not None or not isinstance(error, FileExistsError):
                raise _unwritable(folder, error) from None
            number += 1
            folder = usual.with_name(f"{usual.name}-{number}")


def _lock(marker: TextIO, folder: Path) -> None:
    """Lock a run's marker until it is closed or this process ends, however it ends."""
    try:
        fcntl.flock(marker, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holders = re.findall(rf"^{HEAD}(\d+)$", _text(marker), re.MULTILINE)
        who = f"the run of process {holders[-1]}" if holders else "another run"
        raise InputError(
            f"{folder}: {who} is writing there; wait for its end, or give another folder with --out"
        ) from None
    except OSError:  # a file system without locks
        pass


def _remove_earlier(marker: TextIO, folder: Path) -> None:
    """Remove what an earlier run has written, or nothing if there is more than that."""
    text = _text(marker)
    try:
        if text and not text.startswith(HEAD):
            raise _foreign(folder / MARKER)
        known = _known(text) or _known_to_report(folder)
        ours = [folder / name for name in OF_A_RUN if os.path.lexists(folder / name)]
        for path in ours:
            whole = path.name in known and path.is_file() and not path.is_symlink()
            if not (whole and known[path.name] in (None, digest(path))):
                raise _foreign(path)
    except InputError:
        if not text:
            (folder / MARKER).unlink(missing_ok=True)
        raise
    marker.write(f"{HEAD}{os.getpid()}\n")
    names = "|".join(map(re.escape, OF_A_RUN))
    parts = re.compile(rf"\.({names})\.[0-9a-f]{{8}}{re.escape(PART)}")  # of one that was killed
    ours += [path for path in folder.iterdir() if parts.fullmatch(path.name)]
    for path in ours:
        path.unlink()


def _known(text: str) -> dict[str, str | None]:
    """The files that a marker names, with their digests; None while their run had not ended."""
    words = [line.split() for line in text.splitlines() if not line.startswith("#")]
    return {w[0]: w[1] if len(w) == 2 and len(w[1]) == 64 else None for w in words if w}


def _known_to_report(folder: Path) -> dict[str, None]:
    """The files of a run that has left no marker, as they did at first."""
    try:
        report = json.loads((folder / REPORT).read_text(encoding="utf-8"))
        if not {"drive", "versions"} <= set(report):
            return {}
        fitted = report.get("calibration")
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return {}
    return {name: None for name in OF_A_RUN if fitted or name not in (CAMERA, MOUNT)}


def _text(marker: TextIO) -> str:
    marker.seek(0)
    try:
        return marker.read()
    except UnicodeDecodeError:
        return "no text"


def digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _foreign(path: Path) -> InputError:
    return InputError(
        f"{path}: is there already, and no run of sofjax has written it as it is now; give another "
        "folder with --out, or move the file away"
    )


def _unwritable(folder: Path, error: OSError) -> InputError:
    return InputError(
        f"{folder}: the results cannot be written there ({error.strerror}); "
        "give another folder with --out"
    )


def check_writable(folder: Path) -> None:
    """Make the folder, and a file in it that is gone at once, or say why that cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise _unwritable(folder, error) from None


def check_new(folder: Path) -> None:
    """Refuse a folder in which there is something."""
    try:
        if os.path.lexists(folder) and any(folder.iterdir()):
            raise InputError(f"{folder}: is there already; give a folder of its own with --out")
    except OSError as error:
        raise _unwritable(folder, error) from None


def check_figure(path: Path) -> None:
    """Refuse to draw a figure in the place of a file that is no figure of sofjax's."""
    from sofjax.viewer import SIGNATURE

    _check_replaceable(path, SIGNATURE, "figure")


def check_camera(path: Path) -> None:
    """Refuse to write a camera file in the place of a file that sofjax has not written."""
    from sofjax.io.camera_file import FIRST_LINE

    _check_replaceable(path, FIRST_LINE.encode(), "camera file")
    if path.suffix == ".png":
        raise InputError(f"{path}: is the name of a figure; give one such as camera.yaml with -o")


def _check_replaceable(path: Path, signature: bytes, what: str) -> None:
    if not os.path.lexists(path):
        return
    if path.is_file() and not path.is_symlink():
        with open(path, "rb") as file:
            if signature in file.read(1024):
                return
    raise InputError(
        f"{path}: is there already and is no {what} that sofjax has written; give another name, or "
        "move it away"
    )


def write_json(path: Path, document: object) -> None:
    """JSON in which what is no number is null."""
    write_atomically(path, json.dumps(_plain(document), indent=1, allow_nan=False) + "\n")


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return {key: _plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
