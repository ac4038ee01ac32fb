"""Settings and arguments refuse what they cannot use, by name, where they are defined."""

import dataclasses
from typing import Any

import jax
import jax.core
import numpy as np


def value_of(a: Any) -> np.ndarray | None:
    """The value of a number or an array; None where JAX traces it, maps over it or has it apart."""
    if isinstance(a, jax.core.Tracer) or (isinstance(a, jax.Array) and not a.is_fully_addressable):
        return None
    if isinstance(a, int | float | np.ndarray | np.number | jax.Array):
        return np.asarray(a)
    return None


def check_fields(
    settings: Any,
    *,
    positive: tuple[str, ...] = (),
    at_least_zero: tuple[str, ...] = (),
    at_least_one: tuple[str, ...] = (),
    whole_from: dict[str, int] | None = None,
    choices: dict[str, tuple[str, ...]] | None = None,
) -> None:
    """Raise a ValueError that names class, field, value and what would be right.

    Only values are judged: what JAX traces or maps over has none yet.

    **Arguments:**
    - `positive`, `at_least_zero`, `at_least_one`: fields that are numbers, and their range.
    - `whole_from`: fields that are whole numbers, and the least that is right.
    - `choices`: fields that are one of a few words.
    """

    def refuse(field: str, right: str) -> None:
        value = getattr(settings, field)
        raise ValueError(f"{type(settings).__name__}.{field} must be {right}, not {value!r}")

    for field, words in (choices or {}).items():
        if getattr(settings, field) not in words:
            refuse(field, " or ".join(f"{word!r}" for word in words))
    for field, least in (whole_from or {}).items():
        value = getattr(settings, field)
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
            refuse(field, f"a whole number from {least} on")
    for field in dataclasses.fields(settings):
        if field.type in (bool, "bool") and not isinstance(getattr(settings, field.name), bool):
            refuse(field.name, "True or False")
    ranges = {
        "a number above 0": (positive, lambda numbers: numbers > 0),
        "a number from 0 on": (at_least_zero, lambda numbers: numbers >= 0),
        "a number from 1 on": (at_least_one, lambda numbers: numbers >= 1),
    }
    for right, (fields, holds) in ranges.items():
        for field in fields:
            value = getattr(settings, field)
            if value is None or isinstance(value, bool | str):
                refuse(field, right)
            numbers = value_of(value)
            if numbers is not None and not (np.isfinite(numbers) & holds(numbers)).all():
                refuse(field, right)
