"""Step 3 of the paper's Fig. 6: an image becomes a fixed number of segments."""

import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np

from sofjax.geometry import Segments
from sofjax.io.camera_file import CameraFile, horizon_image
from sofjax.vision.detectors import DETECTORS, Detector
from sofjax.vision.images import read_image
from sofjax.vision.lens import Lens


@dataclass(frozen=True)
class FrontendSettings:
    detector: str = "lsd"  # 'lsd', or 'hough' as in the paper
    capacity: int = 64  # M, segments of an image that are kept
    min_length: float = 12.0  # pixels, below which a segment tells little of a direction


@dataclass(frozen=True)
class View:
    """What the front end makes of one image."""

    segments_image: Segments  # capacity M, pixels of the undistorted image
    overflow: int  # segments that found no place
    detected: int  # segments before packing
    readable: bool  # whether the file held an image of the camera's size
    seconds: dict[str, float]  # of each stage


class Frontend:
    """Reads, undistorts and detects, for one camera. One thread: the filter has the others."""

    def __init__(
        self,
        camera_file: CameraFile,
        settings: FrontendSettings | None = None,
        detector: Detector | None = None,
    ):
        """`detector`: one's own, in the place of the one that the settings name."""
        cv2.setNumThreads(1)
        self.settings = settings or FrontendSettings()
        self.detector = detector or DETECTORS[self.settings.detector]
        self.camera_file = camera_file
        self.lens = Lens(camera_file)
        mount = camera_file.mount
        self._horizon = horizon_image(self.lens.K, float(mount.pitch), float(mount.roll))

    def undistort(self, image: np.ndarray) -> np.ndarray:
        """The image [height, width] as a pinhole camera with the same K would have taken it."""
        return self.lens.undistort(image)

    def detect(self, image: np.ndarray) -> np.ndarray:
        """Segments [S, 4] float32 of an undistorted image, pixels, none shorter than allowed."""
        found = np.asarray(self.detector(image), np.float32).reshape(-1, 4)
        found = self.lens.clip(found[np.isfinite(found).all(1)])
        return found[lengths(found) >= self.settings.min_length]

    def view(self, path: Path) -> View:
        """One image's file, decoded, undistorted, searched and packed."""
        clock = [time.perf_counter()]
        image = read_image(path)
        clock.append(time.perf_counter())
        camera = self.camera_file.camera
        readable = image is not None and image.shape == (camera.height, camera.width)
        if readable:
            image = self.undistort(image)
            clock.append(time.perf_counter())
            segments = self.detect(image)
        else:
            clock.append(time.perf_counter())
            segments = np.zeros((0, 4), np.float32)
        worth = self._length_on_floor(segments)
        packed, overflow = pack(segments, self.settings.capacity, worth)
        clock.append(time.perf_counter())
        stages = ("decode", "undistort", "detect")
        seconds = dict(zip(stages, np.diff(clock).tolist(), strict=True))
        return View(packed, overflow, len(segments), readable, seconds)

    def _length_on_floor(self, segments: np.ndarray) -> np.ndarray:
        """[S] pixels of each segment below the horizon, nearly: the rest cannot be floor."""
        share = np.linspace(0, 1, 5, dtype=np.float32)[:, None]
        points = segments[:, None, :2] + share * (segments[:, None, 2:] - segments[:, None, :2])
        below = points @ self._horizon[:2] + self._horizon[2] > 0
        return lengths(segments) * below.mean(1)


def lengths(segments: np.ndarray) -> np.ndarray:
    """[S] lengths of the segments [S, 4]."""
    return np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])


def pack(
    segments: np.ndarray, capacity: int, worth: np.ndarray | None = None
) -> tuple[Segments, int]:
    """Put segments [S, 4] into `capacity` places, the longest first.

    **Arguments:**
    - `worth`: [S], what to prefer them by in the place of their length.

    **Returns:** the segments in the order of worth, ties in the order of detection; and how many
    found no place.
    """
    worth = lengths(segments) if worth is None else worth
    kept = segments[np.argsort(-worth, kind="stable")[:capacity]]
    endpoints = np.zeros((capacity, 2, 2), np.float32)
    endpoints[: len(kept)] = kept.reshape(-1, 2, 2)
    valid = np.arange(capacity) < len(kept)
    return Segments(jnp.asarray(endpoints, float), jnp.asarray(valid)), len(segments) - len(kept)
