"""JSON files of a user, of limited size."""

import json
from collections import Counter
from pathlib import Path

from sofjax.io.errors import InputError, quoted
from sofjax.io.text import read_text

JSON_BYTES = 16 * 1024 * 1024  # a map of 65,536 segments has 11 MB
JSON_VALUES = 1_500_000  # and a million values


def read_json(path: Path, what: str) -> object:
    """The data of a JSON file; `what` names it in the sentence of the error.

    **Raises:** `InputError`, also for names that are given twice and more values than a map has.
    """
    text = read_text(path, what, JSON_BYTES)
    if sum(map(text.count, "[{,")) > JSON_VALUES:
        raise InputError(f"{path}: more values than {what} has; at most {JSON_VALUES}")
    try:
        return json.loads(text, object_pairs_hook=_named_once)
    except json.JSONDecodeError as error:
        raise InputError(f"{path}, line {error.lineno}: not JSON: {error.msg}") from None
    except _TwiceError as error:
        raise InputError(f"{path}: the name {quoted(error.args[0])} is given twice") from None
    except RecursionError:
        raise InputError(f"{path}: not JSON: nested too deep") from None
    except ValueError:  # of Python's int
        raise InputError(f"{path}: not JSON: a number has too many digits") from None


class _TwiceError(Exception):
    """A name that is given twice."""


def _named_once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    named = dict(pairs)
    if len(named) < len(pairs):
        counts = Counter(name for name, _ in pairs)
        raise _TwiceError(counts.most_common(1)[0][0])
    return named
