"""Decoding of image files."""

from pathlib import Path

import cv2
import numpy as np

from sofjax.io.drive import Drive
from sofjax.io.errors import InputError


def read_image(path: Path, bits: int | None = None) -> np.ndarray | None:
    """The image in grey, [height, width] uint8; None if there is none that can be read.

    The turn that a file's EXIF asks for is not made: the calibration is of the sensor's pixels.

    **Arguments:**
    - `bits`: how many the camera fills of the 16 of an image, of which the upper 8 are kept; by
      default as many as the image's largest value takes.
    """
    image = decode(path)
    if image is None or image.dtype == np.uint8:
        return image
    bits = depth(image) if bits is None else bits
    return np.minimum(image >> (bits - 8), 255).astype(np.uint8)


def decode(path: Path) -> np.ndarray | None:
    """The image in grey as it is stored, [height, width] uint8 or uint16; None if there is none."""
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.fromfile(path, np.uint8), flags)
    except (OSError, cv2.error):
        return None
    return image if image is not None and image.dtype in (np.uint8, np.uint16) else None


def bit_depth(drive: Drive) -> int:
    """How many bits the images of a drive fill, 8 to 16, by the largest value of them all.

    **Raises:** `InputError` if none of the images is one of the camera's.
    """
    camera = drive.camera_file.camera
    other = None
    for file in drive.image_files:
        image = decode(file)
        if image is None:
            continue
        if image.shape == (camera.height, camera.width):
            break
        other = other or (file, image.shape)
    else:
        raise InputError(_none_usable(drive, other))
    if image.dtype == np.uint8:
        return 8
    stored = (decode(file) for file in drive.image_files)
    return max(depth(image) for image in stored if image is not None)


def depth(image: np.ndarray) -> int:
    """How many bits the largest value of an image needs, at least 8."""
    return max(8, int(image.max()).bit_length())


def _none_usable(drive: Drive, other: tuple[Path, tuple[int, int]] | None) -> str:
    camera = drive.camera_file.camera
    if other is None:
        return (
            f"{drive.path / 'rgb.txt'}: none of its {len(drive.image_files)} images can be read; "
            "they must be image files such as JPEG or PNG"
        )
    file, (height, width) = other
    return (
        f"{file}: the image has {width}x{height} pixels and camera.yaml is for "
        f"{camera.width}x{camera.height}; the camera must be that of the images"
    )
