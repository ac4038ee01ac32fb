"""Undistortion: images as a pinhole camera with the same K would have taken them."""

import cv2
import numpy as np

from sofjax.io.camera_file import CameraFile
from sofjax.io.errors import InputError, quoted

SAMPLES = 33  # points of a segment that are looked up in the mask of what the lens saw
MARGIN = 3  # pixels beside its edge that a detector's smoothing mixes


class Lens:
    """The lens of a camera: maps computed once, then one lookup a pixel."""

    def __init__(self, camera_file: CameraFile) -> None:
        camera = camera_file.camera
        self.K = np.asarray(camera.K, float)
        self.distortion = camera_file.distortion
        self.fisheye = camera_file.distortion_model == "equidistant"
        make = cv2.fisheye.initUndistortRectifyMap if self.fisheye else cv2.initUndistortRectifyMap
        size = (camera.width, camera.height)
        exact = make(self.K, self.distortion, np.eye(3), self.K, size, cv2.CV_32FC1)
        self._maps = cv2.convertMaps(*exact, cv2.CV_16SC2)
        self.seen = _seen(*exact)
        if self.seen.mean() < 0.05:
            raise InputError(
                f"camera {quoted(camera_file.name)}: its 'distortion_coefficients' leave nothing "
                f"of the image; they must be those of the model {camera_file.distortion_model}"
            )

    def undistort(self, image: np.ndarray) -> np.ndarray:
        """The undistorted image, of the same size; outside the lens's view its edge is repeated."""
        return cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def undistort_points(self, points: np.ndarray) -> np.ndarray:
        """Points [n, 2] of the image as taken, in pixels of the undistorted one."""
        undistort = cv2.fisheye.undistortPoints if self.fisheye else cv2.undistortPoints
        flat = np.asarray(points, float).reshape(-1, 1, 2)
        return undistort(flat, self.K, self.distortion, P=self.K).reshape(-1, 2)

    def clip(self, segments: np.ndarray) -> np.ndarray:
        """Segments [S, 4] cut back to what the lens saw; [S', 4] of those of which some is left."""
        if self.seen.all() or len(segments) == 0:
            return segments
        first, last = segments[:, None, :2], segments[:, None, 2:]
        share = np.linspace(0, 1, SAMPLES, dtype=np.float32)
        points = first + share[:, None] * (last - first)
        size = np.array(self.seen.shape[::-1])
        columns, rows = np.moveaxis(np.clip(np.rint(points).astype(int), 0, size - 1), -1, 0)
        inside = self.seen[rows, columns]
        begin, end = inside.argmax(1), SAMPLES - 1 - inside[:, ::-1].argmax(1)
        some = np.flatnonzero(inside.any(1) & (begin < end))
        return np.concatenate([points[some, begin[some]], points[some, end[some]]], axis=1)


def _seen(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[height, width] bool: pixels of the undistorted image that the lens has seen.

    Beyond a certain angle the polynomial of a lens may turn back, and shows the image again,
    mirrored. There the determinant of the map's Jacobian is negative. What is connected to the
    middle of the image stays.
    """
    height, width = x.shape
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    x, y = np.where(inside, x, -1e4), np.where(inside, y, -1e4)  # neither infinite nor no number
    (x_v, x_u), (y_v, y_u) = np.gradient(x), np.gradient(y)
    valid = (inside & (x_u * y_v > x_v * y_u)).astype(np.uint8)
    if valid.all():
        return valid.astype(bool)
    framed = cv2.copyMakeBorder(valid, MARGIN, MARGIN, MARGIN, MARGIN, cv2.BORDER_REPLICATE)
    eroded = cv2.erode(framed, np.ones((2 * MARGIN + 1,) * 2, np.uint8))[
        MARGIN:-MARGIN, MARGIN:-MARGIN
    ]
    _, labels = cv2.connectedComponents(eroded)
    middle = labels[height // 2, width // 2]
    return (labels == middle) & (eroded > 0)
