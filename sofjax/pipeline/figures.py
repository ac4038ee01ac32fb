"""The figures of a run, of a fitted mount and of an inspected drive. Without matplotlib none."""

from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from sofjax import viewer
from sofjax.evaluation import RigidMotion
from sofjax.io.trajectory import Trajectory
from sofjax.pipeline.inspect import Inspection
from sofjax.pipeline.results import DriveResult
from sofjax.pipeline.stages import Closed
from sofjax.vision import Frontend, read_image, rectify

if TYPE_CHECKING:
    from sofjax.pipeline.calibrate import Calibration

ELLIPSES = 30  # places of the path, about, whose uncertainty is drawn
SHOWN = 6  # images of an inspected drive
STRETCH = 0.8  # heights of the camera: the path between the two images of a floor
FLOOR = (1.2, 6.0, -2.0, 2.0)  # heights of the camera: x from, to, y from, to, of the floor drawn

Extent = tuple[float, float, float, float]  # metres


def draw_result(path: Path, result: DriveResult) -> bool:
    """The path and the map, in the frame of the truth if it is known.

    **Returns:** whether it is drawn; not without an image or without matplotlib.
    """
    drive, run_log, closed = result.drive, result.log, result.closed
    if not (run_log.stamps and viewer.available()):
        return False
    motion, estimate = result.errors.motion, result.trajectory
    odometry = drive.odometry.at(estimate.stamps)
    turn = estimate.yaw[0] - odometry.yaw[0]
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    odometry = RigidMotion(R, estimate.xy[0] - R @ odometry.xy[0]).apply(odometry.xy)
    to_truth = motion or RigidMotion(np.eye(2), np.zeros(2))
    title = f"{drive.name}: {len(estimate.stamps)} images, {estimate.travelled[-1]:.1f} m"
    if e := result.errors.smoothed or result.errors.trajectory:
        title += f", {e.ate_m:.3f} m and {e.yaw_deg:.2f}° from the true path"
    viewer.draw_map(
        path,
        title,
        viewer.MapFigure(
            robot=to_truth.apply(estimate.xy),
            odometry=to_truth.apply(odometry),
            segments=to_truth.apply(result.segments),
            true_robot=drive.groundtruth.xy if motion and drive.groundtruth else None,
            true_segments=drive.floor_segments if motion else None,
            online=to_truth.apply(run_log.trajectory.xy) if closed else None,
            ellipses=_ellipses(closed, to_truth) if closed else None,
        ),
    )
    return True


def _ellipses(closed: Closed, to_truth: RigidMotion) -> tuple[np.ndarray, np.ndarray]:
    """Middles and covariances at some places of the path."""
    few = slice(0, None, max(1, len(closed.places) // ELLIPSES))
    covariances = to_truth.R @ closed.covariances[few] @ to_truth.R.T
    return to_truth.apply(closed.places[few]), covariances


def draw_inspection(path: Path, found: Inspection) -> bool:
    """A few images with their segments, those that move as the floor does and others.

    **Returns:** whether it is drawn; not without matplotlib.
    """
    if not viewer.available():
        return False
    drive, frontend, seen = found.drive, found.frontend, found.seen
    names, images, floor, other = [], [], [], []
    usable = np.flatnonzero(seen.usable)
    spread = np.linspace(0, len(usable) - 1, SHOWN + 2).round()[1:-1]
    for i in usable[np.unique(spread.astype(int))].tolist():
        file, valid = drive.image_files[i], np.asarray(seen.log.segments_image.valid[i])
        endpoints = np.asarray(seen.log.segments_image.endpoints[i])
        image = read_image(file, frontend.bits)
        assert image is not None, file
        names.append(file.name)
        images.append(frontend.undistort(image))
        floor.append(endpoints[valid & seen.is_floor[i]])
        other.append(endpoints[valid & ~seen.is_floor[i]])
    title = f"{drive.name}: which segments move as the floor does, by eq. (9)"
    viewer.draw_images(path, title, names, images, floor, other)
    return True


def draw_calibration(path: Path, found: "Calibration") -> bool:
    """The residuals of a fitted mount, and the floor by the old and the new one.

    **Returns:** whether it is drawn; not without a pair of segments or without matplotlib.
    """
    valid = np.asarray(found.fit.pairs.valid)
    if not (viewer.available() and valid.any()):
        return False
    old, new = _residuals(found)
    floors, extent = _floors(found)
    title = f"{found.drive.name}: {found.verdict}: {found.sentence}"
    viewer.draw_mount(path, title, old[valid], new[valid], floors, extent)
    return True


def _residuals(found: "Calibration") -> list[np.ndarray]:
    """[N, 4] pixels by the old and by the new rig, the odometer as it was found."""
    from sofjax.calibration.pairs import ODOMETER, Estimate, all_distances

    with jax.enable_x64(True):
        estimate, pairs = jax.tree.map(jnp.asarray, (found.fit.estimate, found.fit.pairs))
        odometer = jnp.zeros_like(estimate.by).at[ODOMETER].set(estimate.bias)
        before = Estimate(estimate.given, odometer)
        return [np.asarray(jax.jit(all_distances)(each, pairs)) for each in (before, estimate)]


def _floors(found: "Calibration") -> tuple[list[list[np.ndarray]], Extent]:
    """Two images on the floor, a stretch of the path apart, by the old and the new rig."""
    drive = found.drive
    height = float(found.camera_file.mount.height)
    at = drive.odometry_at_images
    first, second = _straightest(at, STRETCH * height)
    c, s = np.cos(at.yaw[first]), np.sin(at.yaw[first])
    x, y = np.array([[c, s], [-s, c]]) @ (at.xy[second] - at.xy[first])
    motion = np.array([x, y, at.yaw[second] - at.yaw[first]])
    x0, x1, y0, y1 = (height * share for share in FLOOR)
    extent = (x0, x1, y0, y1)
    floors = []
    for file in (drive.camera_file, found.camera_file):
        frontend, both = Frontend(file), []
        for i, T in ((first, np.zeros(3)), (second, motion)):
            image = read_image(drive.image_files[i])
            if image is not None:
                image = frontend.undistort(image)
                both.append(rectify(image, file.camera, file.mount, T, extent))
        floors.append(both)
    return floors, extent


def _straightest(at: Trajectory, distance: float) -> tuple[int, int]:
    """First and last pose of the straightest stretch of about that length."""
    second = np.searchsorted(at.travelled, at.travelled + distance)
    first = np.flatnonzero(second < len(at.travelled))
    if not len(first):
        return 0, len(at.travelled) - 1
    bend = [np.ptp(at.yaw[i : second[i] + 1]) for i in first]
    i = int(first[int(np.argmin(bend))])
    return i, int(second[i])
