"""Settings as names with dots: from TOML and the command line into frozen dataclasses, and back.

A setting is a leaf of a tree of dataclasses, `motion.distance_noise`; its default tells its type.
The settings of a field with `INLINE` as its metadata are named as if they were of the level above.
"""

import dataclasses
import json
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

from sofjax.io.errors import InputError, nearest, plain, quoted
from sofjax.io.numbers import decimal, whole
from sofjax.io.text import SETTINGS_BYTES, read_text

Config = TypeVar("Config")  # a frozen dataclass
Setting = bool | int | float | str

INLINE = {"inline": True}
DOTS = 100  # in a name


def to_dict(config: Any) -> dict[str, Setting]:
    """Every setting by its name, in the order of the fields."""
    return dict(_leaves(config, ""))


def with_settings(
    config: Config,
    given: Mapping[str, object],
    where: str,
    check: Callable[[str, Setting], None] | None = None,
) -> Config:
    """The same settings with some of them changed.

    **Arguments:**
    - `given`: values by name, of the setting's type, or as text from the command line.
    - `where`: the file or option, for the sentence of an `InputError`.
    - `check`: raises `ValueError` for a name's value that cannot be used.
    """
    known = to_dict(config)
    values = {}
    for name, value in given.items():
        if name not in known:
            raise InputError(f"{where}: there is no setting {quoted(name)}; {nearest(name, known)}")
        values[name] = _cast(f"{where}: '{name}'", value, known[name])
    try:
        for name, value in values.items():
            if check is not None:
                check(name, value)
        return _replace(config, values, "")
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None


def read_toml(path: Path) -> dict[str, object]:
    """The settings of a TOML file by their names; tables become the dots."""
    path = Path(path)
    text = read_text(path, "the settings file", SETTINGS_BYTES)
    for number, line in enumerate(text.splitlines(), start=1):
        dots = line.partition("#")[0].partition("=")[0].count(".")
        if dots > DOTS:  # a key of many takes the square of their number
            raise InputError(
                f"{path}, line {number}: {dots} dots in a name; no setting has so many"
            )
    try:
        return dict(_flatten(tomllib.loads(text), ""))
    except (tomllib.TOMLDecodeError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not TOML: {plain(error)}") from None


def to_toml(settings: Mapping[str, Setting]) -> str:
    """Settings by name as TOML that `read_toml` reads back, number for number."""
    tables: dict[str, list[str]] = {"": []}
    for name, value in settings.items():
        table, _, key = name.rpartition(".")
        tables.setdefault(table, []).append(f"{key} = {_toml(value)}")
    blocks = ([f"[{table}]"] * bool(table) + lines for table, lines in tables.items() if lines)
    return "\n\n".join("\n".join(block) for block in blocks) + "\n"


def _leaves(config: Any, prefix: str) -> Iterator[tuple[str, Setting]]:
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from _leaves(value, _below(field, prefix))
        else:  # a setting that was learned may be an array
            yield prefix + field.name, value.item() if hasattr(value, "item") else value


def _replace(config: Config, values: Mapping[str, Setting], prefix: str) -> Config:
    changed = {}
    for field in dataclasses.fields(cast(Any, config)):
        value: Any = getattr(config, field.name)
        if dataclasses.is_dataclass(type(value)):
            changed[field.name] = _replace(value, values, _below(field, prefix))
        else:
            changed[field.name] = values.get(prefix + field.name, value)
    return dataclasses.replace(cast(Any, config), **changed)


def _below(field: dataclasses.Field, prefix: str) -> str:
    return prefix if field.metadata.get("inline") else f"{prefix}{field.name}."


def _flatten(table: Mapping[str, object], prefix: str) -> Iterator[tuple[str, object]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def _cast(where: str, value: object, like: Setting) -> Setting:
    """A value as the type of the setting's present one; bool before int, which it also is."""
    if isinstance(like, bool):
        if isinstance(value, str):
            value = {"true": True, "false": False}.get(value.lower(), value)
        if isinstance(value, bool):
            return value
        right = "true or false"
    elif isinstance(like, int):
        number = _parsed(whole, value) if isinstance(value, str) else value
        if isinstance(number, int) and not isinstance(number, bool):
            return number
        right = "a whole number"
    elif isinstance(like, float):
        number = _parsed(decimal, value) if isinstance(value, str) else value
        if isinstance(number, int | float) and not isinstance(number, bool):
            if abs(number) <= sys.float_info.max:
                return float(number)
        right = "a finite number"
    else:
        if isinstance(value, str):
            return value
        right = "text"
    raise InputError(f"{where} is {quoted(value)}; it must be {right}")


def _parsed(kind: Callable[[str], Setting], text: str) -> Setting | None:
    try:
        return kind(text)
    except ValueError:
        return None


def _toml(value: Setting) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value)
    return repr(value)
