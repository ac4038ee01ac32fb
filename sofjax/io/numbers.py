"""What a number in a file or an option may be."""

import math
import sys

from sofjax.io.errors import InputError, quoted

FARTHEST = 1e7  # metres from the origin; the northings of UTM end there
LONGEST = 1e4  # metres, of a segment
MAX_SEGMENTS = 65_536  # in a file; as many as a map can have


def decimal(text: str) -> float:
    """The number that plain decimal digits give, such as -1.5e-3, or nan or inf.

    **Raises:** `ValueError` for anything else, also for 1_000 and digits of other scripts, which
    Python's own `float` takes.
    """
    return float(_plain(text))


def whole(text: str) -> int:
    """The whole number that plain decimal digits give; `ValueError` for anything else."""
    return int(_plain(text))


def check_segment(where: str, *ends: int | float) -> None:
    """Refuse a segment x1, y1, x2, y2, metres, that is too long or too far away for a floor."""
    x1, y1, x2, y2 = ends
    if all(abs(value) <= sys.float_info.max for value in ends):
        length = math.hypot(x2 - x1, y2 - y1)
        if length > LONGEST:
            raise InputError(
                f"{where}: a segment of {length:g} m; it must be in metres, {LONGEST:g} at most"
            )
    for value in ends:
        if not abs(value) <= FARTHEST:  # also what is no number
            raise InputError(
                f"{where}: a coordinate of {quoted(value)} m; coordinates are finite metres, at "
                f"most {FARTHEST:g} either way"
            )


def _plain(text: str) -> str:
    if "_" in text or not text.isascii():
        raise ValueError("not plain decimal digits")
    return text
