"""What a camera file says beside lens and mount: clock, shutter, odometer, and how well known."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sofjax.io.camera_forms import mapping, number
from sofjax.io.errors import InputError, nearest, quoted
from sofjax.motion import BIAS
from sofjax.rig import RIG

MAX_OFFSET = 10.0  # seconds; two clocks that differ by more are no clocks of one drive
MAX_LINE_DELAY = 1e-3  # seconds a row
MAX_BIAS = 0.9  # share, and radians a metre
COMMENTS = {
    "time_offset": "seconds to add to an image's stamp, for the odometer's clock",
    "line_delay": "seconds from one row's exposure to the next",
    "odometer": "shares by which its readings are to be changed; curvature in radians a metre",
    "sigma": "standard deviations: height, focal and the odometer's as shares, angles in radians",
}


@dataclass(frozen=True)
class RigFields:
    """Clock, shutter and odometer of a robot's camera file."""

    time_offset: float = 0.0  # seconds to add to an image's stamp, for the odometer's clock
    line_delay: float = 0.0  # seconds a row
    odometer: tuple[float, ...] = (0.0,) * len(BIAS)  # systematic errors b, see `MotionModel`
    sigma: Mapping[str, float] = field(default_factory=dict)  # of numbers of the file, by RIG's
    # and BIAS' names and units, where that is known


def read_rig_fields(path: Path, fields: Mapping) -> RigFields:
    """The fields, checked; zero where there is none."""
    offset = _within(path, fields, "time_offset", MAX_OFFSET, "seconds")
    delay = _within(path, fields, "line_delay", MAX_LINE_DELAY, "seconds from row to row")
    bias = _numbers(path, fields, "odometer", BIAS)
    for name, value in bias.items():
        if abs(value) > MAX_BIAS:
            raise InputError(
                f"{path}: '{name}' of 'odometer' is {value:g}; it must be a share, such as 0.02, "
                f"of at most {MAX_BIAS:g} either way"
            )
    sigma = _numbers(path, fields, "sigma", (*RIG, *BIAS))
    for name, value in sigma.items():
        if value < 0:
            raise InputError(
                f"{path}: '{name}' of 'sigma' is {value:g}; a standard deviation must not be "
                "negative"
            )
    return RigFields(offset, delay, tuple(bias.get(name, 0.0) for name in BIAS), sigma)


def rig_lines(rig: RigFields) -> str:
    """Their lines in a camera file; none of what is zero or not known."""
    odometer = dict(zip(BIAS, rig.odometer, strict=True)) if any(rig.odometer) else {}
    values = {
        "time_offset": repr(rig.time_offset) if rig.time_offset else "",
        "line_delay": repr(rig.line_delay) if rig.line_delay else "",
        "odometer": _flow(odometer),
        "sigma": _flow(rig.sigma),
    }
    return "".join(f"{key}: {value}  # {COMMENTS[key]}\n" for key, value in values.items() if value)


def _flow(values: Mapping[str, float]) -> str:
    inside = ", ".join(f"{name}: {value!r}" for name, value in values.items())
    return f"{{{inside}}}" if inside else ""


def _within(path: Path, fields: Mapping, key: str, limit: float, unit: str) -> float:
    if fields.get(key) is None:
        return 0.0
    value = number(f"{path}: '{key}'", fields[key])
    if not abs(value) <= limit:
        raise InputError(
            f"{path}: '{key}' is {value:g}; it must be in {unit}, at most {limit:g} either way"
        )
    return value


def _numbers(path: Path, fields: Mapping, key: str, names: tuple[str, ...]) -> dict[str, float]:
    where = f"{path}: '{key}'"
    value = fields.get(key)
    given = mapping(where, {} if value is None else value)
    for name in given:
        if name not in names:
            raise InputError(
                f"{where} has no field {quoted(str(name))}; {nearest(str(name), names)}"
            )
    return {name: number(f"{where}: '{name}'", value) for name, value in given.items()}
