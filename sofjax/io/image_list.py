"""`rgb.txt`: the stamps of a drive's images, and their files, all inside the drive's folder."""

import os
from pathlib import Path

import numpy as np

from sofjax.io.errors import InputError, quoted
from sofjax.io.text import rows
from sofjax.io.trajectory import finite, in_nanoseconds, in_order

MAX_NAME = 1000  # characters of an image's path
MAX_IMAGES = 300_000  # more than eight hours at 10 Hz


def read_images(path: Path) -> tuple[np.ndarray, list[Path], bool, list[str]]:
    """Stamps in seconds, files, whether the list has nanoseconds, and remarks."""
    table, at_line = path / "rgb.txt", f"{path / 'rgb.txt'}, line "
    numbers, stamps, names = [], [], []
    for number, line in rows(table, "the list of images"):
        where = f"{at_line}{number}"
        if len(names) == MAX_IMAGES:
            raise InputError(f"{where}: more than {MAX_IMAGES} images; give the drive in parts")
        words = line.split(maxsplit=1)
        if len(words) != 2:
            raise InputError(f"{where}: there must be two columns, 'timestamp file'")
        numbers.append(number)
        stamps.append(finite(where, words[0]))
        names.append(words[1])
    if not names:
        raise InputError(f"{table}: no image in it; there must be a row 'timestamp file' for each")
    at, files = np.array(stamps), np.array(names, object)
    kept, remarks = in_order(table, np.array(numbers), at, files[:, None])
    at, files = at[kept], files[kept].tolist()
    folder = _Folder(path)
    lines = np.array(numbers)[kept].tolist()
    there = [folder.has(f"{at_line}{n}", file) for n, file in zip(lines, files, strict=True)]
    if 2 * sum(there) < len(there):
        raise InputError(
            f"{table}: {len(there) - sum(there)} of its {len(there)} images are missing, "
            f"{quoted(files[there.index(False)])} first; the files must lie where the list says"
        )
    nanoseconds = in_nanoseconds(at)
    if nanoseconds:
        at = 1e-9 * at
    return at, [path / file for file in files], nanoseconds, remarks


class _Folder:
    """The files of a drive's folder; each folder is listed once, and links must not lead out."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._root = path.resolve()
        self._inside: dict[str, dict[str, os.DirEntry]] = {}

    def has(self, where: str, name: str) -> bool:
        """Whether an image is there; refused if its name leaves the drive's folder in any way."""
        odd = len(name) > MAX_NAME or "\0" in name or name.startswith("/")
        if odd or (".." in name and ".." in name.split("/")):
            right = "must be a path inside the drive's folder"
            raise InputError(f"{where}: the image {quoted(name)} {right}")
        parent, _, base = name.rpartition("/")
        if parent not in self._inside:
            self._inside[parent] = self._entries(parent)
            if self._inside[parent]:
                self._check_link(where, parent)
        entry = self._inside[parent].get(base)
        if entry is not None and entry.is_symlink():
            self._check_link(where, name)
        return entry is not None and entry.is_file()

    def _entries(self, parent: str) -> dict[str, os.DirEntry]:
        try:
            with os.scandir(self._path / parent) as entries:
                return {entry.name: entry for entry in entries}
        except OSError:  # no such folder
            return {}

    def _check_link(self, where: str, name: str) -> None:
        try:
            inside = (self._path / name).resolve().is_relative_to(self._root)
        except (OSError, RuntimeError):  # a ring of links
            inside = False
        if not inside:
            raise InputError(
                f"{where}: {quoted(name)} is a link that leads out of the drive's folder"
            )
