"""Camera images of a world: the colour of every ray of every pixel comes from the atlas.

The only module of the simulator that uses OpenCV. `lens_rays` bends the rays as the lens does,
`ray_casting` finds where they end, and `Renderer` turns their colours into an image.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, UInt8

from sofjax.io.camera_file import CameraFile
from sofjax.io.errors import InputError
from sofjax.simulation.rendering.ray_casting import (
    MIRROR_TEXELS,
    RAYS,
    SPREAD,
    cast,
    frame_of,
    in_view,
)
from sofjax.simulation.rendering.texture_atlas import paint_atlas
from sofjax.simulation.world.types import World


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

    def __post_init__(self) -> None:
        """Refuse an impossible camera, in a sentence."""
        for name, value in vars(self).items():
            if not 0 <= value < math.inf:
                raise InputError(
                    f"the camera's {name.replace('_', ' ')} is {value:g}; it must be 0 or more"
                )


WEBCAM = Imaging()


class Renderer:
    """Draws one world as one camera sees it."""

    def __init__(
        self, world: World, camera_file: CameraFile, imaging: Imaging, seed: int = 0
    ) -> None:
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
        faces, tops = in_view(self._atlas, R_world_camera, C)
        frame = frame_of(self._world, self._atlas, R_world_camera, C)
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
