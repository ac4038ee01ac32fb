"""Segments in one grey image: by the Hough transform, as in the paper, or by LSD.

A detector is any function from a grey uint8 image [height, width] to segments [S, 4],
`x1 y1 x2 y2` in pixels, with whole numbers at the middle of a pixel. `DETECTORS` names them: a
row that is added there, `DETECTORS["mine"] = detect`, is a value of the setting `frontend.detector`
and of the option `--detector`.
"""

from collections.abc import Callable

import cv2
import numpy as np

Detector = Callable[[np.ndarray], np.ndarray]

LSD_SCALE = 0.8  # OpenCV's default: LSD works on an image shrunk by this
LSD_SHIFT = 0.5 * (1 / LSD_SCALE - 1)  # pixels that it reports too low for having shrunk it


def detect_lsd(image: np.ndarray) -> np.ndarray:
    """Segments [S, 4] by the line segment detector, to a fraction of a pixel.

    They run with the darker side on one hand. OpenCV scales coordinates back by 1 / 0.8 alone,
    where the middle of pixel u of the small image lies at (u + 0.5) / 0.8 - 0.5 of the large
    one: the difference, 0.125 px, is added here.
    """
    detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, LSD_SCALE)
    return _rows(detector.detect(image)[0]) + np.float32(LSD_SHIFT)


def detect_hough(image: np.ndarray) -> np.ndarray:
    """Segments [S, 4] by Canny's edges and the probabilistic Hough transform, in whole pixels.

    The votes, lengths and gaps go with the size of the image: 20, 20 and 3 px at 320×240.
    """
    edges = cv2.Canny(cv2.GaussianBlur(image, (0, 0), 1.0), 40, 100)
    size = min(image.shape)
    return _rows(
        cv2.HoughLinesP(
            edges,
            rho=1,
            theta=np.pi / 360,
            threshold=max(8, size // 12),
            minLineLength=max(8, size // 12),
            maxLineGap=max(2, size // 80),
        )
    )


DETECTORS: dict[str, Detector] = {"lsd": detect_lsd, "hough": detect_hough}


def _rows(lines: np.ndarray | None) -> np.ndarray:
    """[S, 4] float32, of OpenCV's None, (S, 1, 4) in its version 4, or (S, 4) in its version 5."""
    if lines is None:
        return np.zeros((0, 4), np.float32)
    return np.asarray(lines, np.float32).reshape(-1, 4)
