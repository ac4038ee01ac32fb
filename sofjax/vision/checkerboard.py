"""Intrinsics from views of a board, "a common checkboard method" of section IV."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import cv2
import numpy as np

from sofjax.vision.boards import Board, Correspondences

MIN_VIEWS = 5
OUTLIER = 3.0  # times the median error of the views
NEGLIGIBLE = 0.1  # pixels, below which no view is an outlier
MIN_TILT = 10.0  # degrees, below which focal length and distance cannot be separated
SIGNIFICANT = 2.0  # standard deviations from 0 without which k3 is left out
TERMS = ("k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True)
class BoardView:
    """One image of the board, as the fitted camera explains it."""

    name: str
    corners: np.ndarray  # [N, 2] as found, pixels of the image as taken
    residuals: np.ndarray  # [N, 2] found minus projected, pixels
    distance: float  # metres from the optical centre to the board's middle
    tilt: float  # radians between the board's normal and the ray to its middle
    used: bool  # or left out of the fit, as an outlier

    @property
    def error(self) -> float:
        """Root mean square of the residuals' lengths, pixels."""
        return float(np.sqrt(np.mean(np.sum(self.residuals**2, axis=1))))


@dataclass(frozen=True)
class CameraFit:
    """Intrinsics with one standard deviation each, by the residuals of the used views."""

    width: int  # pixels
    height: int  # pixels
    intrinsics: np.ndarray  # [4] fx, fy, cx, cy, pixels
    intrinsics_sigma: np.ndarray  # [4]
    distortion: np.ndarray  # [5] of the model plumb_bob; k3 is 0 where nothing speaks for one
    distortion_sigma: np.ndarray  # [5]
    views: list[BoardView]
    error: float  # root mean square over the used views, pixels

    @property
    def K(self) -> np.ndarray:
        fx, fy, cx, cy = self.intrinsics
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    @property
    def turning(self) -> float | None:
        """Pixels from the centre at which the lens turns back, if that is within the image."""
        return turning_radius(self.K, self.distortion, self.width, self.height)

    @property
    def focal_uncertainty(self) -> float:
        """Standard deviation of the focal length, as a share of it."""
        return float((self.intrinsics_sigma[:2] / self.intrinsics[:2]).max())


def fit_camera(
    board: Board, width: int, height: int, names: list[str], found: list[Correspondences]
) -> CameraFit:
    """Intrinsics from the views of a board; views that contradict the others are left out.

    **Raises:** `ValueError` if OpenCV finds no camera that could have taken them.
    """
    used = list(range(len(found)))
    while True:
        solution = _solve(width, height, [found[i] for i in used])
        errors = solution.errors
        worst = int(errors.argmax())
        limit = max(OUTLIER * float(np.median(errors)), NEGLIGIBLE)
        if errors[worst] <= limit or len(used) <= MIN_VIEWS:
            break
        del used[worst]
    poses = dict(zip(used, solution.poses, strict=True))
    views = [
        _view(board, solution, name, seen, poses.get(i))
        for i, (name, seen) in enumerate(zip(names, found, strict=True))
    ]
    return CameraFit(
        width,
        height,
        intrinsics=solution.K[[0, 1, 0, 1], [0, 1, 2, 2]],
        intrinsics_sigma=solution.sigma[:4],
        distortion=solution.distortion,
        distortion_sigma=solution.sigma[4:9],
        views=views,
        error=solution.error,
    )


@dataclass(frozen=True)
class _Solution:
    K: np.ndarray
    distortion: np.ndarray  # [5]
    sigma: np.ndarray  # [9] of fx, fy, cx, cy and the distortion
    poses: list[tuple[np.ndarray, np.ndarray]]  # rotation vector and translation of each view
    errors: np.ndarray  # [V] pixels
    error: float


def _solve(width: int, height: int, found: list[Correspondences]) -> _Solution:
    """One fit; k3 is zero unless it is significant: far from the corners it diverges.

    It is zero too if with it the lens would turn back within the image, which no lens does.
    """
    no_guess: Any = None  # OpenCV's stubs want a matrix here
    for flags in (0, cv2.CALIB_FIX_K3):
        try:
            error, K, distortion, R, t, sigma, _, errors = cv2.calibrateCameraExtended(
                [seen.points for seen in found],
                [np.asarray(seen.corners, np.float32) for seen in found],
                (width, height),
                no_guess,
                no_guess,
                flags=flags,
            )
        except cv2.error:
            raise ValueError("no camera explains these views of the board") from None
        sigma, distortion = sigma.ravel()[:9], distortion.ravel()[:5]
        if not (np.isfinite(K).all() and np.isfinite(sigma).all() and math.isfinite(error)):
            raise ValueError("no camera explains these views of the board")
        significant = abs(distortion[4]) > SIGNIFICANT * sigma[8]
        if significant and turning_radius(K, distortion, width, height) is None:
            break
    poses = list(zip(R, t, strict=True))
    return _Solution(K, distortion, sigma, poses, errors.ravel(), float(error))


def turning_radius(K: np.ndarray, distortion: np.ndarray, width: int, height: int) -> float | None:
    """Pixels from the centre at which a plumb_bob lens turns back, if that is within the image.

    With r the distance from the axis at a depth of 1, the lens shows it at
    r (1 + k1 r² + k2 r⁴ + k3 r⁶), which must grow until it is at the farthest corner.
    """
    k1, k2, _, _, k3 = distortion
    slopes = np.roots([7 * k3, 5 * k2, 3 * k1, 1])  # of which r² the derivative is zero
    turns = slopes[(abs(slopes.imag) < 1e-9) & (slopes.real > 0)].real
    if not len(turns):
        return None
    s = turns.min()
    reached = math.sqrt(s) * (1 + s * (k1 + s * (k2 + s * k3)))
    focal = np.diag(K)[:2]
    corners = np.array([[x, y] for x in (0, width - 1) for y in (0, height - 1)])
    farthest = np.linalg.norm((corners - K[:2, 2]) / focal, axis=1).max()
    return None if reached >= farthest else float(reached * focal.mean())


def _view(
    board: Board, solution: _Solution, name: str, seen: Correspondences, pose: tuple | None
) -> BoardView:
    """A view under the final camera; where it was no part of the fit, with its own best pose."""
    camera = solution.K, solution.distortion
    R, t = pose or cv2.solvePnP(seen.points, np.asarray(seen.corners, np.float32), *camera)[1:]
    projected = cv2.projectPoints(seen.points, R, t, *camera)[0].reshape(-1, 2)
    rotation = cv2.Rodrigues(R)[0]
    middle = rotation @ board.points.mean(0) + t.ravel()
    distance = float(np.linalg.norm(middle))
    facing = min(abs(float(rotation[:, 2] @ middle)) / distance, 1.0)
    residuals = seen.corners - projected
    return BoardView(name, seen.corners, residuals, distance, math.acos(facing), bool(pose))


class CameraVerdict(StrEnum):
    """What a fitted camera is worth."""

    GOOD = "good"
    USABLE = "usable"
    NOT_USABLE = "not usable"


@dataclass(frozen=True)
class Verdict:
    """What a fit is worth, with the reasons."""

    word: CameraVerdict
    reasons: list[str]  # how well the camera is known, and what would make it better

    @property
    def usable(self) -> bool:
        return self.word is not CameraVerdict.NOT_USABLE

    @property
    def sentence(self) -> str:
        return f"{self.word}: {'; '.join(self.reasons)}"


def judge(fit: CameraFit) -> Verdict:
    """What a fit is worth, by its standard deviations, its residuals and its views."""
    used = [view for view in fit.views if view.used]
    size = np.array([fit.width, fit.height])
    share, centre = fit.focal_uncertainty, float((fit.intrinsics_sigma[2:] / size).max())
    fx, fy, cx, cy = fit.intrinsics
    tilt = math.degrees(max(view.tilt for view in used))
    advice = []
    if tilt < 20:
        advice.append(
            f"the board is never tilted by more than {tilt:.0f}°: without tilts of 30° and more "
            "a long focal length looks like a near board"
        )
    if len(used) < 10:
        advice.append(f"{len(used)} views are few: take 15 to 20")
    empty = _empty_parts(np.concatenate([view.corners for view in used]), size)
    if empty:
        advice.append(
            f"no corner lies in the {', '.join(empty)} of the image: the lens is guessed there"
        )
    if fit.error > 0.5:
        advice.append(
            f"the residuals of {fit.error:.2f} px are large: is the board flat, are the images "
            "sharp, is the lens a fisheye?"
        )
    if fit.turning is not None:
        advice.append(
            f"the lens turns back {fit.turning:.0f} px from the centre, within the image, as no "
            "lens does: take views that reach the corners"
        )
    off = float(np.abs(np.array([cx, cy]) / size - 0.5).max())
    if tilt < MIN_TILT:  # the fit may then end far from the truth, with small sigmas
        word, known = CameraVerdict.NOT_USABLE, "the views do not fix the focal length"
    elif share > 0.03 or centre > 0.05 or abs(fx / fy - 1) > 0.2 or off > 0.35:
        word, known = CameraVerdict.NOT_USABLE, "the views do not fix the camera"
    else:
        rough = bool(advice) or share > 0.005
        word = CameraVerdict.USABLE if rough else CameraVerdict.GOOD
        known = (
            f"the focal length is known to {100 * share:.2g} % and the centre to "
            f"{fit.intrinsics_sigma[2:].max():.2g} px"
        )
    return Verdict(word, [known, *advice])


def _empty_parts(points: np.ndarray, size: np.ndarray) -> list[str]:
    """Ninths of the image without one of the points [n, 2]."""
    names = [
        ["top left", "top", "top right"],
        ["left", "middle", "right"],
        ["bottom left", "bottom", "bottom right"],
    ]
    cells = np.clip((3 * points / size).astype(int), 0, 2)
    seen = {(row, column) for column, row in cells.tolist()}
    return [names[i][j] for i in range(3) for j in range(3) if (i, j) not in seen]
