"""The exception for wrong input of a user."""

import difflib
from collections.abc import Iterable

MANY = 20  # names that a message lists
QUOTED = 100  # characters of what a user gave that a message quotes


class InputError(ValueError):
    """One sentence for the user: where it is, what is wrong, and what would be right.

    It is one line: characters that cannot be printed are escaped.
    """

    def __init__(self, sentence: str) -> None:
        super().__init__("".join(c if c.isprintable() else repr(c)[1:-1] for c in sentence))


def quoted(value: object) -> str:
    """What a user gave as a message quotes it: of a long text its beginning."""
    if isinstance(value, str):
        return f"'{value}'" if len(value) <= QUOTED else f"'{value[:QUOTED]}...'"
    try:
        value = repr(value)
    except (ValueError, RecursionError):  # more digits or more levels than Python writes
        return "too long to be quoted"
    return value if len(value) <= QUOTED else f"{value[:QUOTED]}..."


def plain(error: Exception | str) -> str:
    """What another library says of an error, on one line of a message."""
    return quoted(str(error) or type(error).__name__)[1:-1]


def nearest(name: str, known: Iterable[str]) -> str:
    """A hint at the known name that a misspelt one was meant to be."""
    known = sorted(known)
    close = difflib.get_close_matches(name[:QUOTED], known, n=1, cutoff=0.5)
    if close:
        return f"did you mean '{close[0]}'?"
    if len(known) > MANY:
        return f"there are {len(known)}, such as {', '.join(known[:: len(known) // 4])}"
    return f"known are {', '.join(known)}"
