"""The one exception for what a user gave and nobody can use."""

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """One sentence for the user: where it is, what is wrong, and what would be right."""


def nearest(name: str, known: Iterable[str]) -> str:
    """A hint at the known name that a misspelt one was meant to be."""
    known = sorted(known)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if close:
        return f"did you mean '{close[0]}'?"
    return f"known are {', '.join(known)}"
