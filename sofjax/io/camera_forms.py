"""A calibration's size, matrix and lens, in the forms that ROS, OpenCV and Kalibr write.

- ROS, a file: image_width, image_height, camera_matrix, distortion_model and -_coefficients.
- ROS, a topic's message: width, height, k or K, distortion_model, d or D.
- OpenCV's FileStorage: image_width, image_height, camera_matrix, distortion_coefficients.
- Kalibr: in cam0 resolution, intrinsics, distortion_model and distortion_coeffs.

Names are taken in upper and lower case. What stands there twice must agree.
"""

import difflib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sofjax.io.errors import InputError, plain, quoted
from sofjax.io.numbers import decimal
from sofjax.io.text import SETTINGS_BYTES, read_text
from sofjax.io.yaml_text import parse_yaml

SIZES = {  # how many coefficients a model comes with; those that it does not have must be zero
    "plumb_bob": (4, 5, 8, 12, 14),
    "rational_polynomial": (5, 8, 12, 14),
    "equidistant": (4, 5),
}
USED = {"plumb_bob": 5, "rational_polynomial": 14, "equidistant": 4}
OTHER_NAMES = {
    "radtan": "plumb_bob",
    "radial-tangential": "plumb_bob",
    "fisheye": "equidistant",
    "none": "none",
    "": "none",
}
MAX_PIXELS = 16384  # a side; more is a typing error, and would fill the memory
MATRIX = ("camera_matrix", "k")
COEFFICIENTS = ("distortion_coefficients", "d", "distortion_coeffs")
KNOWN = {
    *("image_width", "width", "image_height", "height", "resolution", *MATRIX, "intrinsics"),
    *("distortion_model", "fisheye_model", *COEFFICIENTS, "camera_model", "camera_name", "mount"),
    *("rectification_matrix", "projection_matrix", "r", "p"),
    *("time_offset", "line_delay", "odometer", "sigma"),
}


def camera_fields(path: Path) -> Mapping:
    """The fields of a camera file; those of Kalibr's one camera beside what the user has added."""
    text = read_text(path, "the camera file", SETTINGS_BYTES)
    fields = mapping(f"{path}", parse_yaml(text, str(path)))
    cameras = [key for key in fields if re.fullmatch(r"cam\d+", str(key))]
    if not cameras:
        return fields
    if len(cameras) > 1:
        several = plain(" and ".join(cameras))
        raise InputError(f"{path}: holds {several}; keep the one that took the images alone")
    inside = mapping(f"{path}: '{cameras[0]}'", fields[cameras[0]])
    outside = {key: value for key, value in fields.items() if key != cameras[0]}
    for key in inside.keys() & outside.keys():
        raise InputError(f"{path}: '{key}' stands both in '{cameras[0]}' and beside it; keep one")
    return {**inside, **outside}


def size(path: Path, fields: Mapping) -> tuple[int, int]:
    """Width and height, pixels."""
    pairs: dict[str, list] = {}
    for key, pair in named(fields, ("resolution",)).items():
        if not (isinstance(pair, list) and len(pair) == 2):
            raise InputError(f"{path}: '{key}' is {quoted(pair)}; it must be [width, height]")
        pairs[key] = pair
    sides = []
    for i, side in enumerate(("width", "height")):
        given = named(fields, (f"image_{side}", side)) | {k: pair[i] for k, pair in pairs.items()}
        whole = {key: _pixels(path, key, value) for key, value in given.items()}
        sides.append(_agreed(path, whole, f"image_{side}", fields))
    return sides[0], sides[1]


def matrix(path: Path, fields: Mapping, width: int, height: int) -> np.ndarray:
    """The camera matrix K [3, 3], pixels, checked against the size of the image."""
    model = named(fields, ("camera_model",))
    for key, value in model.items():
        if str(value).lower() != "pinhole":
            raise InputError(f"{path}: '{key}' is {quoted(value)}; it must be pinhole")
    given = {
        key: np.array(_numbers(path, key, value, (9,))).reshape(3, 3)
        for key, value in named(fields, MATRIX).items()
    }
    for key, value in named(fields, ("intrinsics",)).items():
        fx, fy, cx, cy = _numbers(path, key, value, (4,))
        given[key] = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    K = _agreed(path, given, MATRIX[0], fields)
    key = next(iter(given))
    if not K.any():
        raise InputError(f"{path}: '{key}' is all zeros, as of a camera that is not calibrated yet")
    shape = np.array([[1, 0, 1], [0, 1, 1], [0, 0, 1]])
    if (K[shape == 0] != 0).any() or K[2, 2] != 1:
        right = "[fx, 0, cx, 0, fy, cy, 0, 0, 1]"
        raise InputError(f"{path}: '{key}' must have the form {right}")
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise InputError(f"{path}: the focal lengths of '{key}' must be positive pixels")
    centre, sides = K[:2, 2], np.array([width, height])
    if (centre < 0.1 * sides).any() or (centre > 0.9 * sides).any():
        raise InputError(
            f"{path}: the principal point ({centre[0]:g}, {centre[1]:g}) of '{key}' is not "
            f"in the middle of a {width}x{height} image; the matrix must be that of this image size"
        )
    return K


def lens(path: Path, fields: Mapping) -> tuple[str, np.ndarray, list[str]]:
    """The distortion's model, a key of `SIZES`, its coefficients [n] and remarks on them."""
    models = {key: _model(path, key, v) for key, v in named(fields, ("distortion_model",)).items()}
    flags = named(fields, ("fisheye_model",))
    models |= {key: "equidistant" for key, value in flags.items() if value not in (0, False)}
    given = {
        key: np.array(_numbers(path, key, value, None))
        for key, value in named(fields, COEFFICIENTS).items()
    }
    remarks = []
    if models:
        model = _agreed(path, models, "distortion_model", fields)
    else:
        _refuse_slip(path, "distortion_model", fields)
        model = "plumb_bob"
    if model == "none" and not given:
        return "plumb_bob", np.zeros(USED["plumb_bob"]), remarks
    distortion = _agreed(path, given, COEFFICIENTS[0], fields)
    key = next(iter(given))
    if model == "none":
        if distortion.any():
            raise InputError(
                f"{path}: '{next(iter(models))}' names none and '{key}' is not zero; it must be "
                f"one of {', '.join(SIZES)}"
            )
        return "plumb_bob", np.zeros(USED["plumb_bob"]), remarks
    if not models:
        if distortion[USED[model] :].any():
            model = "rational_polynomial"
        if not flags:
            remarks.append(f"the camera file has no 'distortion_model': {model} is supposed")
    if len(distortion) not in SIZES[model]:
        right = " or ".join(map(str, SIZES[model]))
        raise InputError(f"{path}: '{key}' has {len(distortion)} numbers and must have {right}")
    if distortion[USED[model] :].any():
        raise InputError(
            f"{path}: '{key}' of the model {model} must be zero after the first {USED[model]}; "
            "is the model another?"
        )
    return model, distortion[: USED[model]], remarks


def mapping(where: str, value: object) -> Mapping:
    if not isinstance(value, Mapping):
        raise InputError(f"{where}: must hold 'name: value' pairs, as a ROS camera_info file does")
    return value


def named(fields: Mapping, names: Sequence[str]) -> dict[str, object]:
    """The fields of one of these names, in any case, by their names in the file."""
    return {str(key): value for key, value in fields.items() if str(key).lower() in names}


def number(where: str, value: object) -> float:
    """A finite number; also '1e-5', which calibration tools write and YAML 1.1 reads as a word."""
    try:
        number = decimal(str("no" if isinstance(value, bool) else value))
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{where} is {quoted(value)}; it must be a number") from None
    if not math.isfinite(number):
        raise InputError(f"{where} is {number}; it must be finite")
    return number


def _refuse_slip(path: Path, name: str, fields: Mapping) -> None:
    """Refuse a file that has, in place of the field `name`, an unused one of nearly that name."""
    unused = [str(key) for key in fields if str(key).lower() not in KNOWN]
    for close in difflib.get_close_matches(name, unused, n=1, cutoff=0.7):
        raise InputError(f"{path}: the field '{name}' is missing; did you mean {quoted(close)}?")


def _agreed(path: Path, given: Mapping, name: str, fields: Mapping) -> Any:
    """The value that all given names agree on; `name` is the one to ask for if none is given."""
    if not given:
        _refuse_slip(path, name, fields)
        raise InputError(f"{path}: the field '{name}' is missing")
    (key, value), *others = given.items()
    for other, another in others:
        if not np.array_equal(value, another):
            raise InputError(f"{path}: '{key}' and '{other}' contradict each other; keep one")
    return value


def _pixels(path: Path, key: str, value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 8 <= value <= MAX_PIXELS:
        right = f"it must be whole pixels, from 8 to {MAX_PIXELS}"
        raise InputError(f"{path}: '{key}' is {quoted(value)}; {right}")
    return value


def _model(path: Path, key: str, value: object) -> str:
    """A key of `SIZES`, or none."""
    word = "" if value is None else value
    word = word.strip().lower() if isinstance(word, str) else "no word"
    model = OTHER_NAMES.get(word, word)
    if model not in SIZES and model != "none":
        raise InputError(
            f"{path}: '{key}' is {quoted(value)}; it must be one of {', '.join(SIZES)}"
        )
    return model


def _numbers(path: Path, key: str, value: object, sizes: Iterable[int] | None) -> list[float]:
    """The numbers of a list, of a list of rows, or of the `data` of {rows, cols, data}."""
    data = value.get("data") if isinstance(value, Mapping) else value
    if not isinstance(data, list):
        raise InputError(f"{path}: '{key}' must have 'data: [...]', a list of numbers")
    if data and all(isinstance(row, list) and len(row) == len(data[0]) for row in data):
        data = [entry for row in data for entry in row]
    if sizes is not None and len(data) not in sizes:
        right = " or ".join(map(str, sizes))
        raise InputError(f"{path}: '{key}' has {len(data)} numbers and must have {right}")
    return [number(f"{path}: a number of '{key}'", entry) for entry in data]
