"""Step 3 of the paper's Fig. 6: an image becomes a fixed number of segments."""

import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np

from sofjax.geometry import Segments
from sofjax.io.camera_file import CameraFile, horizon_image
from sofjax.io.drive import Drive
from sofjax.vision.detectors import DETECTORS, Detector
from sofjax.vision.images import bit_depth, read_image
from sofjax.vision.lens import Lens

NO_IMAGE, OTHER_SIZE = "cannot be read", "have another size than the camera's"
REPEATED = "repeat the image before while the robot moves"


@dataclass(frozen=True)
class FrontendSettings:
    """How an image becomes segments. Refuses a detector that `DETECTORS` does not name."""

    detector: str = "lsd"  # a name of `DETECTORS`: 'lsd', or 'hough' as in the paper
    capacity: int = 64  # M, segments of an image that are kept
    min_length: float = 12.0  # pixels: shorter segments have no useful direction

    def __post_init__(self) -> None:
        if self.detector not in DETECTORS:
            raise ValueError(
                f"there is no detector {self.detector!r}; it must be {' or '.join(DETECTORS)}"
            )
        if self.capacity < 1:
            raise ValueError(f"capacity is {self.capacity}; it must be 1 or more")
        if not self.min_length >= 0:
            raise ValueError(f"min_length is {self.min_length}; it must not be negative")


@dataclass(frozen=True)
class ImageSegments:
    """What the front end makes of one image."""

    segments_image: Segments  # capacity M, pixels of the undistorted image
    overflow: int  # segments that found no place
    detected: int  # segments before packing
    fault: str  # why it is not used: unreadable, another size, a repetition; "" if it is
    seconds: dict[str, float]  # of each stage

    @property
    def readable(self) -> bool:
        return not self.fault


class Frontend:
    """Reads, undistorts and detects, for one camera. One thread: the filter has the others."""

    def __init__(
        self,
        camera_file: CameraFile,
        settings: FrontendSettings | None = None,
        detector: Detector | None = None,
        bits: int | None = None,
    ) -> None:
        """**Arguments:**
        - `detector`: one's own, in the place of the one that the settings name.
        - `bits`: of images of 16 bits, as of `read_image`.
        """
        cv2.setNumThreads(1)
        self.settings = settings or FrontendSettings()
        self.detector = detector or DETECTORS[self.settings.detector]
        self.camera_file = camera_file
        self.bits = bits
        self.lens = Lens(camera_file)
        mount = camera_file.mount
        self._horizon = horizon_image(self.lens.K, float(mount.pitch), float(mount.roll))

    @classmethod
    def of(cls, drive: Drive, settings: FrontendSettings | None = None) -> "Frontend":
        """For the images of a drive, once it is known that there are some and of how many bits.

        **Raises:** `InputError` if none of the images is one of the camera's.
        """
        return cls(drive.camera_file, settings, bits=bit_depth(drive))

    @property
    def remarks(self) -> list[str]:
        """Sentences on how the images are read."""
        if self.bits in (None, 8):
            return []
        return [f"the images have 16 bits; by their largest value the camera fills {self.bits}"]

    def undistort(self, image: np.ndarray) -> np.ndarray:
        """The image [height, width] as a pinhole camera with the same K would have taken it."""
        return self.lens.undistort(image)

    def detect(self, image: np.ndarray) -> np.ndarray:
        """Segments [S, 4] float32 of an undistorted image, pixels, none shorter than allowed."""
        found = np.asarray(self.detector(image), np.float32).reshape(-1, 4)
        found = self.lens.clip(found[np.isfinite(found).all(1)])
        return found[lengths(found) >= self.settings.min_length]

    def view(self, path: Path) -> ImageSegments:
        """One image's file, decoded, undistorted, searched and packed."""
        clock = [time.perf_counter()]
        image = read_image(path, self.bits)
        clock.append(time.perf_counter())
        fault = self._fault(image)
        if image is not None and not fault:
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
        seconds: dict[str, float] = dict(zip(stages, np.diff(clock).tolist(), strict=True))
        return ImageSegments(packed, overflow, len(segments), fault, seconds)

    def _fault(self, image: np.ndarray | None) -> str:
        camera = self.camera_file.camera
        if image is None:
            return NO_IMAGE
        return "" if image.shape == (camera.height, camera.width) else OTHER_SIZE

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
