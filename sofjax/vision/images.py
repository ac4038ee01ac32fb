"""Decoding of image files."""

from pathlib import Path

import cv2
import numpy as np

from sofjax.io.drive import Drive
from sofjax.io.errors import InputError


def read_image(path: Path) -> np.ndarray | None:
    """The image in grey, [height, width] uint8; None if there is none that can be read.

    The turn that a file's EXIF asks for is not made: the calibration is of the sensor's pixels.
    """
    try:
        data = np.fromfile(path, np.uint8)
        return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except (OSError, cv2.error):
        return None


def check_images(drive: Drive) -> None:
    """Refuse a drive whose images none can read, or whose first one is not the camera's."""
    camera = drive.camera_file.camera
    for file in drive.image_files:
        image = read_image(file)
        if image is None:
            continue
        height, width = image.shape
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                f"{file}: the image has {width}x{height} pixels and camera.yaml is for "
                f"{camera.width}x{camera.height}; the camera must be that of the images"
            )
        return
    raise InputError(
        f"{drive.path / 'rgb.txt'}: none of its {len(drive.image_files)} images can be read; they "
        "must be image files such as JPEG or PNG"
    )
