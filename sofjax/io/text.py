"""Reading a text file that a user named, and writing files whole or not at all."""

import itertools
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, TextIO

from sofjax.io.errors import InputError

TABLE_BYTES = 256 * 1024 * 1024  # an hour of odometry at 100 Hz has 25 MB
SETTINGS_BYTES = 96 * 1024  # also a camera's, with the corners of the images that it is from
LINE, LINES = 16384, 5_000_000  # characters and lines of a table; an hour at 1 kHz has 3,600,000
PART = ".sofjax-part"  # ends the name of a file that is being written


def read_text(path: Path, what: str, max_bytes: int) -> str:
    """The text of a file; `what` names it in the sentence of the error."""
    with _readable(path, what, max_bytes) as file:
        return file.read()


def rows(path: Path, what: str) -> Iterator[tuple[int, str]]:
    """(line number, line) of a table's rows, without blank lines and those that begin with #."""
    with _readable(path, what, TABLE_BYTES) as file:
        for number in itertools.count(1):
            line = file.readline(LINE + 1)
            if not line:
                return
            if len(line) > LINE:
                raise InputError(f"{path}, line {number}: longer than {LINE} characters")
            if number > LINES:
                raise InputError(f"{path}: more than {LINES} lines are too many for {what}")
            line = line.strip()
            if line and not line.startswith("#"):
                yield number, line


@contextmanager
def _readable(path: Path, what: str, max_bytes: int) -> Iterator[TextIO]:
    """A text file to read; what goes wrong with it in the block is an `InputError`."""
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise InputError(f"{path}: {what} must be a file, and this is not one")
        if size > max_bytes:
            raise InputError(f"{path}: {size} bytes are too many for {what}; at most {max_bytes}")
        with open(path, encoding="utf-8-sig") as file:
            yield file
    except UnicodeDecodeError:
        raise InputError(f"{path}: {what} must be text in UTF-8, and this is not") from None
    except FileNotFoundError:
        raise InputError(f"{path}: {what} is missing") from None
    except OSError as error:
        raise InputError(f"{path}: {what} cannot be read ({error.strerror})") from None


def write_atomically(path: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    with replacing(path) as file:
        file.write(text.encode("utf-8"))


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A new file to write, which takes the place of `path` at the end of the block.

    A reader sees the old content or the new, never a part. The new file has a name of its own
    until then, so that nothing else is overwritten.

    **Raises:** `OSError` that names `path`, such as for a full disk; the old file is as it was.
    """
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}{PART}")
    try:
        with open(part, "xb") as file:
            yield file
        os.replace(part, path)
    except OSError as error:
        error.filename, error.filename2 = str(path), None
        raise
    finally:
        part.unlink(missing_ok=True)
