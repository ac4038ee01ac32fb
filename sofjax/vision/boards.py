"""Boards to calibrate a camera with, and where an image shows their points."""

import dataclasses
import functools
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

PATTERNS = ("chessboard", "circles", "acircles", "charuco")
WINDOW = 0.4  # half side of the window that refines a corner, share of the distance to the next
MAX_WINDOW = 11  # pixels, its largest half side: in larger ones the lens bends the lines
MIN_POINTS = 8  # of a ChArUco board, of which an image may show a part
MIN_BLOB_GAP = 4  # pixels between the middles of circles
SETS = (  # of ChArUco's markers; of each row the first that has enough of them
    *(tuple(f"{n}X{n}_{count}" for count in (50, 100, 250, 1000)) for n in (4, 5, 6, 7)),
    *(("ARUCO_ORIGINAL",), ("APRILTAG_16h5",), ("APRILTAG_25h9",), ("APRILTAG_36h11",)),
)


@dataclass(frozen=True)
class Board:
    """A flat board with points whose places are known.

    A chessboard's points are its inner corners, at which four squares meet, and so are those of a
    ChArUco board, whose white squares hold markers. Those of a grid of circles are their middles:
    row above row (`circles`), or every other row half a step aside (`acircles`).
    """

    columns: int  # points along: inner corners or circles; with ChArUco squares
    rows: int  # and across
    square: float  # metres: side of a square; from circle to circle, or with `acircles` row to row
    pattern: str = "chessboard"  # one of PATTERNS
    marker: float = 0.0  # metres, side of a ChArUco board's markers
    dictionary: str = ""  # OpenCV's name of the markers' set; `recognise` finds it
    legacy: bool = False  # ChArUco as OpenCV drew it before 4.6

    @property
    def points(self) -> np.ndarray:
        """[N, 3] float32, all points in the board's frame, row after row, metres."""
        inner = 1 if self.pattern == "charuco" else 0
        rows, columns = np.mgrid[inner : self.rows, inner : self.columns]
        if self.pattern == "acircles":
            columns = 2 * columns + rows % 2
        flat = np.stack([columns, rows, np.zeros_like(rows)], axis=-1)
        return self.square * flat.reshape(-1, 3).astype(np.float32)

    @property
    def things(self) -> str:
        """What its points are, in a word."""
        return "circles" if self.pattern in ("circles", "acircles") else "corners"

    def __str__(self) -> str:
        return f"{self.columns}x{self.rows}"


@dataclass(frozen=True)
class Correspondences:
    """What one image shows of a board."""

    points: np.ndarray  # [n, 3] float32 in the board's frame, metres
    corners: np.ndarray  # [n, 2] where they are in the image, pixels


def find_points(image: np.ndarray, board: Board) -> Correspondences | None:
    """The board's points in a grey image; None unless all are in view, or of ChArUco's enough."""
    if board.pattern == "charuco":
        return _charuco(image, board, board.dictionary, board.legacy) if board.dictionary else None
    find = _chessboard if board.pattern == "chessboard" else _circles
    corners = find(image, board)
    return None if corners is None else Correspondences(board.points, corners)


def recognise(board: Board, images: Iterable[np.ndarray]) -> Board:
    """A ChArUco board with the set of markers that shows most of it; other boards unchanged."""
    if board.pattern != "charuco":
        return board
    count = board.columns * board.rows // 2
    enough = [[name for name in names if len(_markers(name).bytesList) >= count] for names in SETS]
    for image in images:
        seen = [
            (len(found.points), name, legacy)
            for name, *_ in filter(None, enough)
            for legacy in (False, True)
            if (found := _charuco(image, board, name, legacy)) is not None
        ]
        if seen:
            _, name, legacy = max(seen, key=lambda s: s[0])
            return dataclasses.replace(board, dictionary=name, legacy=legacy)
    return board


def _chessboard(image: np.ndarray, board: Board) -> np.ndarray | None:
    """Corners [N, 2] in the order of the board's, pixels.

    Found by OpenCV's sector-based search, or else by its older one, then refined where the edges
    around each cross, within a window without any other corner.
    """
    size = (board.columns, board.rows)
    search = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(image, size, flags=search)
    if not found:
        search = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(image, size, flags=search)
    if not found:
        return None
    grid = corners.reshape(board.rows, board.columns, 2)
    gap = min(np.linalg.norm(np.diff(grid, axis=a), axis=-1).min() for a in (0, 1))
    window = int(np.clip(WINDOW * gap, 2, MAX_WINDOW))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
    refined = cv2.cornerSubPix(
        image, np.array(corners, np.float32), (window, window), (-1, -1), stop
    )
    return refined.reshape(-1, 2)


def _circles(image: np.ndarray, board: Board) -> np.ndarray | None:
    """Middles [N, 2] of dark circles in the order of the board's, pixels."""
    blobs = cv2.SimpleBlobDetector_Params()  # pyright: ignore[reportAttributeAccessIssue]
    blobs.maxArea = image.size / (board.columns * board.rows)
    blobs.minDistBetweenBlobs = MIN_BLOB_GAP
    detector = cv2.SimpleBlobDetector_create(blobs)  # pyright: ignore[reportAttributeAccessIssue]
    grid = cv2.CALIB_CB_ASYMMETRIC_GRID if board.pattern == "acircles" else 0
    grid = grid or cv2.CALIB_CB_SYMMETRIC_GRID
    for flags in (grid, grid | cv2.CALIB_CB_CLUSTERING):
        size = (board.columns, board.rows)
        found, corners = cv2.findCirclesGrid(image, size, flags=flags, blobDetector=detector)
        if found:
            return corners.reshape(-1, 2)
    return None


def _charuco(
    image: np.ndarray, board: Board, dictionary: str, legacy: bool
) -> Correspondences | None:
    """The corners in view between the markers; None if they are few or all in a line."""
    corners, ids, _, _ = _charuco_detector(board, dictionary, legacy).detectBoard(image)
    if ids is None or len(ids) < MIN_POINTS:
        return None
    points = board.points[np.asarray(ids, int).ravel()]
    if np.linalg.matrix_rank(points[:, :2] - points[0, :2], tol=0.5 * board.square) < 2:
        return None
    return Correspondences(points, np.asarray(corners, float).reshape(-1, 2))


@functools.lru_cache
def _charuco_detector(board: Board, dictionary: str, legacy: bool) -> cv2.aruco.CharucoDetector:
    whole, count = _markers(dictionary), board.columns * board.rows // 2
    # the board has the first markers of the set, and fewer are faster to distinguish
    markers = cv2.aruco.Dictionary(
        whole.bytesList[:count], whole.markerSize, whole.maxCorrectionBits
    )
    size = (board.columns, board.rows)
    drawn = cv2.aruco.CharucoBoard(size, board.square, board.marker, markers)
    drawn.setLegacyPattern(legacy)
    return cv2.aruco.CharucoDetector(drawn)


def _markers(name: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
