"""The folder that a run writes."""

import json
import math
import time
from pathlib import Path

from sofjax.io.errors import InputError
from sofjax.io.text import write_atomically

TRAJECTORY, SMOOTHED = "trajectory.txt", "trajectory_smoothed.txt"
MAP, FIGURE = "map.geojson", "map.png"
REPORT, CONFIG = "report.json", "config.toml"
CAMERA, MOUNT = "camera.yaml", "mount.png"  # of `run --calibrate`


def make_folder(out: Path | None, name: str) -> Path:
    """The folder for the results, there and writable; what an earlier run left in it is removed."""
    folder = out or _unused(Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}")
    check_writable(folder)
    for file in (TRAJECTORY, SMOOTHED, MAP, FIGURE, REPORT, CONFIG, CAMERA, MOUNT):
        (folder / file).unlink(missing_ok=True)
    return folder


def check_writable(folder: Path) -> None:
    """Make the folder and a file in it, or say why that cannot be."""
    probe = folder / ".sofjax-probe"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(
            f"{folder}: the results cannot be written there ({error.strerror}); "
            "give another folder with --out"
        ) from None


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


def _unused(folder: Path) -> Path:
    """The folder's name, with a number behind it if two runs begin in one second."""
    free, number = folder, 2
    while free.exists():
        free, number = folder.with_name(f"{folder.name}-{number}"), number + 1
    return free
