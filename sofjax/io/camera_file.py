"""`camera.yaml`: a ROS camera_info file, and under `mount:` where the camera sits on the robot."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from sofjax.geometry import Camera, Mount
from sofjax.io.errors import InputError, nearest
from sofjax.io.text import SETTINGS_BYTES, read_text, write_atomically
from sofjax.io.yaml_text import parse_yaml

MODELS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}  # coefficients
MOUNT_FIELDS = ("x", "y", "height", "pitch", "roll", "yaw")
TO_FILL_IN = {  # what stands in a new file for what only the user knows
    "height": "fill in the metres from the floor to the lens",
    "pitch": "fill in the radians that the camera looks down",
}
FIRST_LINE = (  # of every camera file that is written here
    "# camera_info, with the mount of the camera on the robot: metres, radians, "
    "pitch > 0 looks down"
)
MAX_PIXELS = 16384  # a side; more is a slip, and would fill the memory


@dataclass(frozen=True)
class CameraFile:
    """A camera with its lens, and its place on the robot."""

    camera: Camera  # of the undistorted image, which keeps K and the size
    mount: Mount
    distortion: np.ndarray  # [n] float64, in the order of OpenCV and ROS
    distortion_model: str  # a key of MODELS
    name: str


def read_camera(path: Path) -> CameraFile:
    """Read and check a camera file.

    **Raises:** `InputError` that names the field for whatever cannot be a camera on a robot that
    sees the floor.
    """
    path = Path(path)
    text = read_text(path, "the camera file", SETTINGS_BYTES)
    fields = _mapping(f"{path}", parse_yaml(text, str(path)))
    width, height = (_size(path, fields, key) for key in ("image_width", "image_height"))
    K = _intrinsics(path, fields, width, height)
    model, distortion = _distortion(path, fields)
    mount = _mount(path, fields)
    check_floor_in_view(f"{path}", K, width, height, mount)
    return CameraFile(
        camera=Camera(jnp.asarray(K, float), width, height),
        mount=Mount.create(**mount),
        distortion=distortion,
        distortion_model=model,
        name=str(fields.get("camera_name", path.parent.name)),
    )


def write_camera(path: Path, camera_file: CameraFile) -> None:
    """Write a camera file that `read_camera` reads back, number for number."""
    mount = camera_file.mount
    write_intrinsics(
        path,
        camera_file.camera,
        camera_file.distortion_model,
        camera_file.distortion,
        camera_file.name,
        {key: getattr(mount, key) for key in MOUNT_FIELDS},
    )


def write_intrinsics(
    path: Path,
    camera: Camera,
    distortion_model: str,
    distortion: np.ndarray,
    name: str,
    mount: Mapping[str, object],
    notes: Sequence[str] = (),
) -> None:
    """Write a camera file of whose mount only some fields may be known.

    Where the height or the pitch is missing `TO_FILL_IN` stands in its place, and `read_camera`
    refuses the file until it is filled in.

    **Arguments:**
    - `mount`: metres and radians by the names of `Mount`'s fields.
    - `notes`: lines to stand as comments at the top.
    """
    placed = ", ".join(
        f"{key}: {_shortest(mount[key]) if key in mount else TO_FILL_IN.get(key, 0.0)}"
        for key in MOUNT_FIELDS
    )
    K = ", ".join(map(_shortest, np.asarray(camera.K).ravel()))
    data = ", ".join(map(_shortest, distortion))
    name = "".join(c for c in name if c.isprintable()).replace("'", "''")
    comments = "".join(f"# {note}\n" for note in notes)
    write_atomically(
        Path(path),
        f"{FIRST_LINE}\n"
        f"{comments}"
        f"image_width: {camera.width}\n"
        f"image_height: {camera.height}\n"
        f"camera_name: '{name}'\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: [{K}]}}\n"
        f"distortion_model: {distortion_model}\n"
        f"distortion_coefficients: {{rows: 1, cols: {len(distortion)}, data: [{data}]}}\n"
        f"mount: {{{placed}}}\n",
    )


def mount_fields(where: str, text: str) -> dict[str, float]:
    """Some fields of a mount as 'height=0.6,pitch=0.26', checked; metres and radians."""
    given: dict[str, object] = {}
    for pair in text.split(","):
        key, equals, value = (part.strip() for part in pair.partition("="))
        if not equals:
            raise InputError(f"{where}: '{pair:.40}' must have the form height=0.6,pitch=0.26")
        if key in given:
            raise InputError(f"{where}: '{key}' is given twice")
        given[key] = value
    return _mount_numbers(where, given)


def known_mount(path: Path) -> dict[str, float]:
    """The fields of the mount in a camera file that are filled in; none if there is no mount."""
    text = read_text(path, "the camera file", SETTINGS_BYTES)
    fields = _mapping(f"{path}", parse_yaml(text, str(path)))
    mount = _mapping(f"{path}: 'mount'", fields.get("mount", {}))
    return _mount_numbers(f"{path}: 'mount'", mount)


def doubts(camera_file: CameraFile) -> list[str]:
    """Sentences on what is possible and unlikely: worth a look, no reason to refuse."""
    camera, mount = camera_file.camera, camera_file.mount
    size = np.array([camera.width, camera.height])
    K = np.asarray(camera.K, float)
    found = []
    off = np.abs(K[:2, 2] / size - 0.5)
    if off.max() > 0.2:
        found.append(
            f"the principal point ({K[0, 2]:.1f}, {K[1, 2]:.1f}) is far from the middle of a "
            f"{size[0]}x{size[1]} image: is the camera matrix that of another size?"
        )
    if abs(K[0, 0] / K[1, 1] - 1) > 0.1:
        found.append(f"the focal lengths {K[0, 0]:.1f} and {K[1, 1]:.1f} px differ by over 10 %")
    if float(mount.height) > 3:
        found.append(f"the camera is {float(mount.height):g} m above the floor: is it in metres?")
    return found


def check_floor_in_view(
    where: str, K: np.ndarray, width: int, height: int, mount: Mapping[str, float]
) -> None:
    """Refuse a mount that has the whole image above the horizon."""
    right, bottom = width - 1, height - 1
    corners = np.array([[0, 0, 1], [right, 0, 1], [0, bottom, 1], [right, bottom, 1]])
    if (corners @ horizon_image(K, mount["pitch"], mount["roll"]) <= 0).all():
        raise InputError(
            f"{where}: with the pitch {mount['pitch']:g} of 'mount' the whole image is above the "
            "horizon; pitch > 0 looks down, in radians"
        )


def horizon_image(K: np.ndarray, pitch: float, roll: float) -> np.ndarray:
    """The horizon as an image line l [3]: l · (x, y, 1) > 0 for the pixels below it.

    The same line as `geometry.floor.horizon`'s, to a scale, in plain numpy: it is looked at before
    anything is compiled.
    """
    down = [np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll), np.sin(pitch)]
    return np.linalg.solve(np.asarray(K, float).T, np.array(down))  # down · K^-1 x = l · x


def _mapping(where: str, value: object) -> Mapping:
    if not isinstance(value, Mapping):
        raise InputError(f"{where}: must hold 'name: value' pairs, as a ROS camera_info file does")
    return value


def _field(path: Path, fields: Mapping, key: str) -> object:
    if key not in fields:
        known = [str(k) for k in fields]
        close = nearest(key, known) if known else ""
        hint = f"; {close}" if close.startswith("did") else ""
        raise InputError(f"{path}: the field '{key}' is missing{hint}")
    return fields[key]


def _size(path: Path, fields: Mapping, key: str) -> int:
    value = _field(path, fields, key)
    if isinstance(value, bool) or not isinstance(value, int) or not 8 <= value <= MAX_PIXELS:
        right = f"it must be whole pixels, from 8 to {MAX_PIXELS}"
        raise InputError(f"{path}: '{key}' is {value!r:.60}; {right}")
    return value


def _number(where: str, value: object) -> float:
    """A finite number; YAML 1.1 takes '1e-5' for a word, as calibration tools write it."""
    try:
        number = float("no" if isinstance(value, bool) else value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{where} is {value!r:.60}; it must be a number") from None
    if not math.isfinite(number):
        raise InputError(f"{where} is {number}; it must be finite")
    return number


def _matrix(path: Path, fields: Mapping, key: str, sizes: tuple[int, ...] | None) -> np.ndarray:
    """The data of `key: {rows, cols, data}`, or of a bare list."""
    value = _field(path, fields, key)
    data = value.get("data") if isinstance(value, Mapping) else value
    if not isinstance(data, list):
        raise InputError(f"{path}: '{key}' must have 'data: [...]', a list of numbers")
    if sizes is not None and len(data) not in sizes:
        right = " or ".join(map(str, sizes))
        raise InputError(f"{path}: '{key}' has {len(data)} numbers and must have {right}")
    return np.array([_number(f"{path}: a number of '{key}'", v) for v in data])


def _intrinsics(path: Path, fields: Mapping, width: int, height: int) -> np.ndarray:
    K = _matrix(path, fields, "camera_matrix", (9,)).reshape(3, 3)
    shape = np.array([[1, 0, 1], [0, 1, 1], [0, 0, 1]])
    if (K[shape == 0] != 0).any() or K[2, 2] != 1:
        right = "[fx, 0, cx, 0, fy, cy, 0, 0, 1]"
        raise InputError(f"{path}: 'camera_matrix' must have the form {right}")
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise InputError(f"{path}: the focal lengths of 'camera_matrix' must be positive pixels")
    centre, size = K[:2, 2], np.array([width, height])
    if (centre < 0.1 * size).any() or (centre > 0.9 * size).any():
        raise InputError(
            f"{path}: the principal point ({centre[0]:g}, {centre[1]:g}) of 'camera_matrix' is not "
            f"in the middle of a {width}x{height} image; the matrix must be that of this image size"
        )
    return K


def _distortion(path: Path, fields: Mapping) -> tuple[str, np.ndarray]:
    model = _field(path, fields, "distortion_model")
    if not isinstance(model, str) or model not in MODELS:
        raise InputError(
            f"{path}: 'distortion_model' is {model!r:.60}; it must be one of {', '.join(MODELS)}"
        )
    return model, _matrix(path, fields, "distortion_coefficients", MODELS[model])


def _mount(path: Path, fields: Mapping) -> dict[str, float]:
    if "mount" not in fields:
        raise InputError(
            f"{path}: the field 'mount' is missing; it says where the camera sits on the robot, "
            "such as 'mount: {x: 0.1, y: 0, height: 0.6, pitch: 0.26, roll: 0, yaw: 0}'"
        )
    given = _mapping(f"{path}: 'mount'", fields["mount"])
    mount = _mount_numbers(f"{path}: 'mount'", given)
    for key, what in TO_FILL_IN.items():
        if key not in mount:
            raise InputError(f"{path}: 'mount' must have a '{key}'; {what}")
    return dict.fromkeys(MOUNT_FIELDS, 0.0) | mount


def _mount_numbers(where: str, given: Mapping) -> dict[str, float]:
    """The fields of a mount that are filled in, each a number that can be one."""
    given = {key: v for key, v in given.items() if v is None or v != TO_FILL_IN.get(key)}
    for key in given:
        if key not in MOUNT_FIELDS:
            hint = nearest(str(key), MOUNT_FIELDS)
            raise InputError(f"{where} has no field {key!r:.60}; {hint}")
    mount = {key: _number(f"{where}: '{key}'", value) for key, value in given.items()}
    if not 0 < mount.get("height", 1.0) <= 100:
        raise InputError(
            f"{where}: 'height' is {mount['height']:g}; it must be the metres of the camera "
            "above the floor, greater than 0"
        )
    for key in ("x", "y"):
        if abs(mount.get(key, 0.0)) > 100:
            raise InputError(f"{where}: '{key}' is {mount[key]:g}; it must be in metres")
    for key, limit in (("pitch", math.pi / 2), ("roll", math.pi), ("yaw", 2 * math.pi)):
        if abs(mount.get(key, 0.0)) > limit:
            raise InputError(
                f"{where}: '{key}' is {mount[key]:g}; angles are in radians, at most "
                f"{limit:.4f} either way (15 degrees are 0.2618)"
            )
    return mount


def _shortest(value: object) -> str:
    """The shortest digits that give the same number back, at the number's own precision."""
    text = str(np.asarray(value)[()])
    mantissa, _, exponent = text.partition("e")
    return mantissa + ("" if "." in mantissa else ".0") + (f"e{exponent}" if exponent else "")
