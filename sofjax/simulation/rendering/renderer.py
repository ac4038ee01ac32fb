"""Camera images of a world: every ray of every pixel looks its colour up in the atlas.

This module alone of the simulator uses OpenCV. Rays leave through the lens as it is, distortion
and all, six to a pixel, and end at the nearest of floor, ceiling, walls and boxes: so what hides
what, and where an edge lies, is exact.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, UInt8

from sofjax.io.camera_file import CameraFile
from sofjax.io.errors import InputError
from sofjax.simulation.rendering.texture_atlas import Atlas, paint_atlas
from sofjax.simulation.world.types import World

# Where the rays of a pixel pass through it: no two in one row or column, so that edges along
# either axis are smoothed in six steps.
RAYS = (np.array([[0, 3], [1, 0], [2, 4], [3, 1], [4, 5], [5, 2]]) - 2.5) / 6
NEAR_FLOOR = 4.0  # metres along the view; beyond, the floor's coarse picture is used
SPREAD = (0.65, 0.8, 1.0, 1.25, 1.55)  # of a rough floor's mirrored rays, drawn out along the view
MIRROR_TEXELS = 20.0  # per metre, of the lamps as the floor mirrors them


@dataclass(frozen=True)
class Imaging:
    """What a cheap camera does to a picture."""

    noise: float = 2.5  # grey values of 255, standard deviation at middle grey
    blur: float = 0.55  # pixels, standard deviation of the lens's blur
    exposure_time: float = 0.008  # seconds, for the blur of turning
    brightness: float = 105.0  # grey value that the automatic exposure aims at
    hunting: float = 0.06  # share by which it sways
    adaptation: float = 1.0  # seconds that it takes to follow
    vignetting: float = 0.15  # share of light lost in the corners

    def check(self) -> None:
        """Refuse a camera that cannot be, in a sentence."""
        for name, value in vars(self).items():
            if not 0 <= value < math.inf:
                raise InputError(
                    f"the camera's {name.replace('_', ' ')} is {value:g}; 0 is the least"
                )


WEBCAM = Imaging()


class Renderer:
    """Draws one world as one camera sees it."""

    def __init__(self, world: World, camera_file: CameraFile, imaging: Imaging, seed: int = 0):
        imaging.check()
        self._world = world
        self._imaging = imaging
        self._camera = camera_file.camera
        self._rays = jnp.asarray(lens_rays(camera_file), jnp.float32)
        self._atlas = paint_atlas(world, seed)
        self._mirror = _mirrored_lamps(world)
        self._vignette = _vignette(self._camera.width, self._camera.height, imaging.vignetting)
        self._rng = np.random.default_rng([seed, 23])
        self._phase = self._rng.uniform(0, 2 * np.pi, 2)
        self._exposure, self._exposed_at = 0.0, 0.0

    def draw(
        self,
        R_world_camera: Float[np.ndarray, "3 3"],
        C: Float[np.ndarray, "3"],
        stamp: float,
        turn_rate: float = 0.0,
    ) -> UInt8[np.ndarray, "height width 3"]:
        """One image, blue, green, red; stamps go up from call to call.

        **Arguments:**
        - `R_world_camera`, `C`: pose of the camera, metres.
        - `stamp`: seconds; `turn_rate`: radians per second, for the blur.
        """
        faces, tops = _in_view(self._atlas, R_world_camera, C)
        frame = _frame(self._world, self._atlas, R_world_camera, C)
        columns, rows, gleam = cast(self._rays, frame, faces, tops)
        height, width = self._camera.height, self._camera.width
        shape = (len(RAYS) * height, width)
        colours = cv2.remap(
            self._atlas.image,
            np.asarray(columns).reshape(shape),
            np.asarray(rows).reshape(shape),
            cv2.INTER_LINEAR,
        )
        image = (
            colours.reshape(len(RAYS), height, width, 3).sum(0, dtype=np.uint16).astype(np.float32)
        )
        image *= np.float32(1 / len(RAYS))
        mirrored = self._mirrored(gleam)
        image += mirrored[..., None]
        return self._develop(image, stamp, turn_rate)

    def _mirrored(self, gleam: tuple[Array, Array, Array]) -> Float32[np.ndarray, "height width"]:
        """Light of the lamps in the floor, grey values."""
        height, width = self._camera.height, self._camera.width
        columns, rows = (np.asarray(v).reshape(len(SPREAD) * height, width) for v in gleam[:2])
        strength = np.asarray(gleam[2]).reshape(height, width)
        lamps = cv2.remap(
            self._mirror, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
        )
        return lamps.reshape(len(SPREAD), height, width).mean(0) * strength * np.float32(255)

    def _develop(self, image: np.ndarray, stamp: float, turn_rate: float) -> np.ndarray:
        """Exposure, blur, noise and rounding."""
        image *= self._vignette * self._expose(float(image.mean()), stamp)
        focal = float(self._camera.K[0, 0])
        smear = abs(turn_rate) * self._imaging.exposure_time * focal
        sigma_y = max(self._imaging.blur, 0.05)
        sigma_x = float(np.hypot(sigma_y, smear / np.sqrt(12)))
        image = cv2.GaussianBlur(image, (0, 0), sigmaX=sigma_x, sigmaY=sigma_y)
        if self._imaging.noise > 0:
            image += self._noise(image.shape) * np.sqrt((image + 20) / 148)
        return cv2.cvtColor(np.clip(image + 0.5, 0, 255).astype(np.uint8), cv2.COLOR_RGB2BGR)

    def _expose(self, mean: float, stamp: float) -> np.float32:
        """The gain of an automatic exposure that follows the picture late, and sways."""
        wanted = np.clip(self._imaging.brightness / max(mean, 1.0), 0.3, 4.0)
        late = np.exp(-abs(stamp - self._exposed_at) / self._imaging.adaptation)
        self._exposure = wanted + (late * (self._exposure - wanted) if self._exposure > 0 else 0.0)
        self._exposed_at = stamp
        sway = np.sin(0.9 * stamp + self._phase[0]) + 0.5 * np.sin(2.3 * stamp + self._phase[1])
        return np.float32(self._exposure * (1 + self._imaging.hunting * sway / 1.5))

    def _noise(self, shape: tuple[int, ...]) -> Float32[np.ndarray, "height width 3"]:
        draws = self._rng.standard_normal((*shape[:2], 2), np.float32) * np.float32(
            self._imaging.noise
        )
        grey, tint = draws[..., :1], draws[..., 1:]
        return np.concatenate([grey, grey + 0.3 * tint, grey - 0.3 * tint], axis=-1)


def write_image(path: Path, image: UInt8[np.ndarray, "height width 3"]) -> None:
    """Write a JPEG of good quality."""
    coded, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 92])
    if not coded:
        raise OSError(None, "the image cannot be coded", str(path))
    path.write_bytes(data.tobytes())


def lens_rays(camera_file: CameraFile) -> Float[np.ndarray, "3 rays"]:
    """Directions in the camera frame, depth 1, of `RAYS` of every pixel of the image as taken.

    The lens's polynomial is inverted by Newton's method at the middle of every pixel, and taken
    as linear within it.

    **Raises:** `InputError` if the lens bends the image over itself inside the picture.
    """
    camera = camera_file.camera
    K = np.asarray(camera.K, float)
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    wanted = np.stack([columns.ravel(), rows.ravel()], axis=-1).astype(float)
    x = (wanted - K[:2, 2]) / np.diag(K)[:2]
    for _ in range(20):
        pixels, slope = _distorted(camera_file, x)
        move = np.linalg.solve(slope, (wanted - pixels)[..., None])[..., 0]
        x = x + np.clip(move, -0.3, 0.3)
        if np.abs(move).max() < 1e-7:
            break
    pixels, slope = _distorted(camera_file, x)
    if not (np.abs(pixels - wanted).max() < 0.02 and np.linalg.det(slope).min() > 0):
        raise InputError(
            f"the distortion {', '.join(f'{v:g}' for v in camera_file.distortion)} folds the image "
            "over itself; its coefficients must keep straight lines apart up to the corners"
        )
    directions = x + np.einsum("pij,rj->rpi", np.linalg.inv(slope), RAYS)
    directions = directions.reshape(-1, 2)
    return np.concatenate([directions, np.ones((len(directions), 1))], axis=1).T


def _distorted(camera_file: CameraFile, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of directions (x, y, 1) through the lens [n, 2], and their slope [n, 2, 2]."""
    K = np.asarray(camera_file.camera.K, float)

    def through(points: np.ndarray) -> np.ndarray:
        if camera_file.distortion_model == "equidistant":
            bent = cv2.fisheye.distortPoints(points[:, None], K, camera_file.distortion)
        else:
            solid = np.concatenate([points, np.ones((len(points), 1))], axis=1)
            bent = cv2.projectPoints(solid, np.zeros(3), np.zeros(3), K, camera_file.distortion)[0]
        return bent.reshape(-1, 2)

    h = 1e-4
    steps = np.eye(2) * h
    slope = [(through(x + step) - through(x - step)) / (2 * h) for step in steps]
    return through(x), np.stack(slope, axis=-1)


def _in_view(
    atlas: Atlas, R_world_camera: np.ndarray, C: np.ndarray
) -> tuple[Float[Array, "faces 10"], Float[Array, "tops 7"]]:
    """Faces and tops that the camera may see, as the rows that `cast` takes."""
    faces, tops = atlas.faces, atlas.tops
    nadir, ahead = C[:2], R_world_camera[:2, 2]
    to_start = faces.start - nadir
    normal = np.stack([-faces.along[:, 1], faces.along[:, 0]], axis=-1)
    distance = -(to_start * normal).sum(1)  # of the camera in front of the face
    ends = np.stack([to_start, to_start + faces.length[:, None] * faces.along], axis=1)
    seen = (distance > 1e-3) & ((ends @ ahead).max(1) > -2.0)
    g = -normal / np.where(seen, distance, 1)[:, None]  # 1 / depth of the face along d is g·d
    s0 = -(to_start * faces.along).sum(1)
    face_rows = np.column_stack(
        [g, faces.along, s0, faces.length, faces.height, faces.origin, np.ones(len(s0))]
    )[seen]
    below = tops.height < C[2]
    rise = np.where(below, C[2] - tops.height, 1)
    top_rows = np.column_stack([1 / rise, tops.rect - np.tile(nadir, 2), tops.origin])[below]
    return _padded(face_rows, 8), _padded(top_rows, 4)


def _padded(rows: np.ndarray, multiple: int) -> Array:
    """Rows of zeros added, so that only few lengths occur and `cast` is seldom compiled."""
    short = -len(rows) % multiple
    return jnp.asarray(np.pad(rows, ((0, short), (0, 0))), jnp.float32)


class Frame(eqx.Module):
    """What all rays of a frame share; a picture is its column, row and texels a metre."""

    R_world_camera: Float32[Array, "3 3"]
    C: Float32[Array, "3"]  # metres
    ceiling: Float32[Array, ""]  # metres
    gloss: Float32[Array, ""]
    corner: Float32[Array, "2"]  # lower left of the plan, metres
    texels: Float32[Array, ""]  # per metre, of faces and tops
    floor: Float32[Array, "3"]
    far_floor: Float32[Array, "3"]
    over: Float32[Array, "3"]


def _frame(world: World, atlas: Atlas, R_world_camera: np.ndarray, C: np.ndarray) -> Frame:
    corner = world.corridors[:, :2].min(0)
    pictures = [
        np.append(p.origin, p.texels) for p in (atlas.floor, atlas.far_floor, atlas.ceiling)
    ]
    shared = (R_world_camera, C, world.ceiling, world.look.gloss, corner, atlas.texels, *pictures)
    return Frame(*(jnp.asarray(value, jnp.float32) for value in shared))


@jax.jit
def cast(
    rays: Float32[Array, "3 rays"],
    frame: Frame,
    faces: Float32[Array, "faces 10"],
    tops: Float32[Array, "tops 7"],
) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """Where each ray ends, as column and row of the atlas.

    Nearness, the inverse of the distance along a ray, is affine in its direction for every plane,
    so the nearest surface is found without a division.

    **Returns:** columns and rows of the atlas [rays]; and for the first ray of every pixel the
    columns and rows [SPREAD, pixels] of the lamps that it sees mirrored, and how strongly.
    """
    x, y, height = frame.C
    dx, dy, dz = frame.R_world_camera @ rays
    nearest = jnp.zeros_like(dx)  # nearness of the nearest face
    along = jnp.zeros_like(dx)  # nearness × metres along the face
    column0, row0 = jnp.zeros_like(dx), jnp.zeros_like(dx)
    for i in range(faces.shape[0]):
        gx, gy, ux, uy, s0, length, top, column, row, exists = faces[i]
        near = gx * dx + gy * dy
        s = s0 * near + ux * dx + uy * dy
        inside = (s >= 0) & (s <= length * near) & (dz <= (top - height) * near)
        closer = inside & (near > nearest) & (exists > 0)
        nearest = jnp.where(closer, near, nearest)
        along = jnp.where(closer, s, along)
        column0, row0 = jnp.where(closer, column, column0), jnp.where(closer, row, row0)
    is_top = jnp.zeros_like(dx, bool)
    for i in range(tops.shape[0]):
        inverse_rise, x0, y0, x1, y1, column, row = tops[i]
        near = -dz * inverse_rise
        inside = (dx >= x0 * near) & (dx <= x1 * near) & (dy >= y0 * near) & (dy <= y1 * near)
        closer = inside & (near > nearest) & (inverse_rise > 0)
        nearest = jnp.where(closer, near, nearest)
        column0, row0 = jnp.where(closer, column, column0), jnp.where(closer, row, row0)
        is_top = is_top | closer

    floor, above = -dz / height, dz / (frame.ceiling - height)
    level = jnp.maximum(floor, above)
    on_face = nearest >= level
    distance = 1 / jnp.maximum(jnp.where(on_face, nearest, level), 1e-4)
    column, row, scale = (
        jnp.where(dz < 0, jnp.where(distance < NEAR_FLOOR, near, far), over)
        for near, far, over in zip(frame.floor, frame.far_floor, frame.over, strict=True)
    )
    px, py, pz = x + distance * dx, y + distance * dy, height + distance * dz
    face_columns = column0 + frame.texels * jnp.where(is_top, px, along * distance)
    face_rows = row0 + frame.texels * jnp.where(is_top, py, pz)
    columns = jnp.where(on_face, face_columns, column + scale * px)
    rows = jnp.where(on_face, face_rows, row + scale * py)

    first = rays.shape[1] // len(RAYS)
    dx, dy, dz, nearest, floor = (v[:first] for v in (dx, dy, dz, nearest, floor))
    reach = (1 + frame.ceiling / height) / jnp.maximum(floor, 1e-4)  # to the mirrored ceiling
    grazing = 1 + dz / jnp.sqrt(dx * dx + dy * dy + dz * dz)
    mirrors = (floor > nearest) & (nearest * reach < 1)
    strength = jnp.where(mirrors, frame.gloss * (0.1 + 0.9 * grazing**3), 0)
    spread = [reach * share for share in SPREAD]
    x, y = frame.C[:2] - frame.corner
    mirror_columns = jnp.stack([(x + r * dx) * MIRROR_TEXELS - 0.5 for r in spread])
    mirror_rows = jnp.stack([(y + r * dy) * MIRROR_TEXELS - 0.5 for r in spread])
    return columns, rows, (mirror_columns, mirror_rows, strength)


def _mirrored_lamps(world: World) -> Float32[np.ndarray, "rows columns"]:
    """The lamps as a floor that is not quite smooth mirrors them, 0 to 1."""
    low, high = world.corridors[:, :2].min(0), world.corridors[:, 2:].max(0)
    columns, rows = np.ceil((high - low) * MIRROR_TEXELS).astype(int)
    lamps = np.zeros((rows, columns), np.float32)
    for lamp, light in zip(world.lamps, world.lamp_light, strict=True):
        x0, y0, x1, y1 = np.round((lamp - np.tile(low, 2)) * MIRROR_TEXELS).astype(int)
        lamps[y0:y1, x0:x1] = light
    return cv2.GaussianBlur(lamps, (0, 0), 0.06 * MIRROR_TEXELS)


def _vignette(width: int, height: int, loss: float) -> Float32[np.ndarray, "height width 1"]:
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    return (1 - loss * (x**2 + y**2) / 2)[..., None].astype(np.float32)
