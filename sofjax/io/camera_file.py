"""`camera.yaml`: a calibration, and under `mount:` where the camera sits on the robot."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import SupportsFloat, TypeVar

import jax.numpy as jnp
import numpy as np

from sofjax.geometry import Camera, Mount
from sofjax.io.camera_forms import camera_fields, lens, mapping, matrix, number, size
from sofjax.io.errors import InputError, nearest, quoted
from sofjax.io.rig_fields import RigFields, read_rig_fields, rig_lines
from sofjax.io.text import write_atomically
from sofjax.rig import Lens, Rig

Number = TypeVar("Number", bound=SupportsFloat)

ANGLES = ("pitch", "roll", "yaw")
MOUNT_FIELDS = ("x", "y", "height", *ANGLES)
TO_FILL_IN = {  # placeholders in a new file for what only the user knows
    "height": "fill in the metres from the floor to the lens",
    "pitch": "fill in the radians that the camera looks down",
}
PLAIN = RigFields()  # a clock that agrees, an odometer that is right
ROUNDING = 1e-3  # radians: an angle rounded to three digits may exceed its limit by this
FIRST_LINE = (  # of every camera file that is written here
    "# camera_info, with the mount of the camera on the robot: metres, radians, "
    "pitch > 0 looks down"
)


@dataclass(frozen=True)
class CameraFile:
    """A camera with its lens, and its place on the robot."""

    camera: Camera  # of the undistorted image, which keeps K and the size
    mount: Mount
    distortion: np.ndarray  # [n] float64, in the order of OpenCV and ROS
    distortion_model: str  # plumb_bob, rational_polynomial or equidistant
    name: str
    remarks: tuple[str, ...] = ()  # sentences on what the file does not say
    rig_fields: RigFields = PLAIN  # clock, shutter and odometer

    @property
    def rig(self) -> Rig:
        """The rig, whose clock and shutter are those of the file."""
        fisheye = self.distortion_model == "equidistant"
        number = lambda value: jnp.asarray(value, float)
        return Rig(
            self.camera, self.mount, Lens.of(self.distortion, fisheye),
            number(self.rig_fields.time_offset), number(self.rig_fields.line_delay),
        )  # fmt: skip


def read_camera(path: Path) -> CameraFile:
    """Read and check a camera file.

    **Raises:** `InputError` that names the field for whatever cannot be a camera on a robot that
    sees the floor.
    """
    path = Path(path)
    fields = camera_fields(path)
    width, height = size(path, fields)
    K = matrix(path, fields, width, height)
    model, distortion, remarks = lens(path, fields)
    mount = _mount(path, fields)
    check_floor_in_view(f"{path}", K, width, height, mount)
    name = fields.get("camera_name")
    return CameraFile(
        camera=Camera(jnp.asarray(K, float), width, height),
        mount=Mount.create(**mount),
        distortion=distortion,
        distortion_model=model,
        name=path.parent.name if name is None else str(name),
        remarks=tuple(remarks),
        rig_fields=read_rig_fields(path, fields),
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
        rig_fields=camera_file.rig_fields,
    )


def write_intrinsics(
    path: Path,
    camera: Camera,
    distortion_model: str,
    distortion: np.ndarray,
    name: str,
    mount: Mapping[str, SupportsFloat],
    notes: Sequence[str] = (),
    rig_fields: RigFields = PLAIN,
) -> None:
    """Write a camera file; only some fields of its mount need be known.

    Where the height or the pitch is missing `TO_FILL_IN` stands in its place, and `read_camera`
    refuses the file until it is filled in.

    **Arguments:**
    - `mount`: metres and radians by the names of `Mount`'s fields.
    - `notes`: lines to stand as comments at the top.
    - `rig_fields`: of which only what is not zero is written.
    """
    mount = {**mount, **_canonical({key: mount[key] for key in ANGLES if key in mount})}
    placed = ", ".join(
        f"{key}: {_shortest(mount[key]) if key in mount else TO_FILL_IN.get(key, 0.0)}"
        for key in MOUNT_FIELDS
    )
    K = ", ".join(map(_shortest, np.asarray(camera.K).ravel()))
    data = ", ".join(map(_shortest, distortion))
    name = _printable(name).replace("'", "''")
    comments = "".join(f"# {_printable(note)}\n" for note in notes)
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
        f"mount: {{{placed}}}\n"
        f"{rig_lines(rig_fields)}",
    )


def mount_fields(where: str, text: str) -> dict[str, float]:
    """Some fields of a mount as 'height=0.6,pitch=0.26', checked; metres and radians."""
    given: dict[str, object] = {}
    for pair in text.split(","):
        key, equals, value = (part.strip() for part in pair.partition("="))
        if not equals:
            raise InputError(f"{where}: {quoted(pair)} must have the form height=0.6,pitch=0.26")
        if key in given:
            raise InputError(f"{where}: {quoted(key)} is given twice")
        given[key] = value
    return _mount_numbers(where, given)


def known_mount(path: Path) -> dict[str, float]:
    """The fields of the mount in a camera file that are filled in; none if there is no mount."""
    mount = mapping(f"{path}: 'mount'", camera_fields(path).get("mount", {}))
    return _mount_numbers(f"{path}: 'mount'", mount)


def known_rig_fields(path: Path) -> RigFields:
    """Clock, shutter and odometer of a camera file, whatever else is missing in it."""
    return read_rig_fields(path, camera_fields(path))


def doubts(camera_file: CameraFile) -> list[str]:
    """Sentences on values that are possible but unlikely."""
    camera, mount = camera_file.camera, camera_file.mount
    size = np.array([camera.width, camera.height])
    K = np.asarray(camera.K, float)
    found = list(camera_file.remarks)
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
    """Refuse a mount by which the whole image lies above the horizon."""
    right, bottom = width - 1, height - 1
    corners = np.array([[0, 0, 1], [right, 0, 1], [0, bottom, 1], [right, bottom, 1]])
    if (corners @ horizon_image(K, mount["pitch"], mount["roll"]) <= 0).all():
        raise InputError(
            f"{where}: with the pitch {mount['pitch']:g} of 'mount' the whole image is above the "
            "horizon; pitch > 0 looks down, in radians"
        )


def horizon_image(K: np.ndarray, pitch: float, roll: float) -> np.ndarray:
    """The horizon as an image line l [3]: l · (x, y, 1) > 0 for the pixels below it.

    The same line as `geometry.floor.horizon`'s, to a scale, in plain NumPy, as it is used before
    anything is compiled.
    """
    down = [np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll), np.sin(pitch)]
    return np.linalg.solve(np.asarray(K, float).T, np.array(down))  # down · K^-1 x = l · x


def _mount(path: Path, fields: Mapping) -> dict[str, float]:
    if "mount" not in fields:
        raise InputError(
            f"{path}: the field 'mount' is missing; it says where the camera sits on the robot, "
            "such as 'mount: {x: 0.1, y: 0, height: 0.6, pitch: 0.26, roll: 0, yaw: 0}'"
        )
    given = mapping(f"{path}: 'mount'", fields["mount"])
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
            raise InputError(f"{where} has no field {quoted(key)}; {hint}")
    mount = {key: number(f"{where}: '{key}'", value) for key, value in given.items()}
    if not 0 < mount.get("height", 1.0) <= 100:
        raise InputError(
            f"{where}: 'height' is {mount['height']:g}; it must be the metres of the camera "
            "above the floor, greater than 0"
        )
    for key in ("x", "y"):
        if abs(mount.get(key, 0.0)) > 100:
            raise InputError(f"{where}: '{key}' is {mount[key]:g}; it must be in metres")
    for key, limit, words in (
        ("pitch", math.pi / 2, "a quarter"),
        ("roll", 2 * math.pi, "a full"),
        ("yaw", 2 * math.pi, "a full"),
    ):
        if abs(mount.get(key, 0.0)) > limit + ROUNDING:
            raise InputError(
                f"{where}: '{key}' is {mount[key]:g}; angles are in radians, at most {words} "
                f"turn, {limit:.4f}, either way (15 degrees are 0.2618)"
            )
    return mount | _canonical({key: mount[key] for key in ANGLES if key in mount})


def _canonical(angles: Mapping[str, Number]) -> dict[str, Number | float]:
    """The same tilt with the pitch in [-pi/2, pi/2], and roll and yaw in (-pi, pi], radians.

    A pitch that is over its limit by no more than `ROUNDING` is taken for the limit. An angle that
    is within its limits stays the number that it is.
    """
    turned: dict[str, float] = {key: float(value) for key, value in angles.items()}
    if "pitch" in turned:
        pitch = turned["pitch"] = _wrapped(turned["pitch"])
        if abs(pitch) > math.pi / 2 + ROUNDING:  # over the vertical: the other way, upside down
            turned["pitch"] = math.copysign(math.pi, pitch) - pitch
            turned |= {key: turned.get(key, 0.0) + math.pi for key in ("roll", "yaw")}
        else:
            turned["pitch"] = min(max(pitch, -math.pi / 2), math.pi / 2)
    turned |= {key: _wrapped(turned[key]) for key in ("roll", "yaw") if key in turned}
    kept = {key: value for key, value in angles.items() if turned[key] == float(value)}
    return turned | kept


def _wrapped(angle: float) -> float:
    """The same direction in (-pi, pi], radians; half a turn to float32's digits is pi."""
    wrapped = math.remainder(angle, 2 * math.pi)
    return math.pi if abs(wrapped) > math.pi - 3e-7 else wrapped


def _printable(text: str) -> str:
    return "".join(c for c in text if c.isprintable())


def _shortest(value: object) -> str:
    """The shortest digits that give the same number back, at the number's own precision."""
    text = str(np.asarray(value)[()])
    mantissa, _, exponent = text.partition("e")
    return mantissa + ("" if "." in mantissa else ".0") + (f"e{exponent}" if exponent else "")
