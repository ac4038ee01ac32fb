"""Decoding of image files."""

from pathlib import Path

import cv2
import numpy as np


def read_image(path: Path) -> np.ndarray | None:
    """The image in grey, [height, width] uint8; None if there is none that can be read.

    The turn that a file's EXIF asks for is not made: the calibration is of the sensor's pixels.
    """
    try:
        data = np.fromfile(path, np.uint8)
        return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except (OSError, cv2.error):
        return None
