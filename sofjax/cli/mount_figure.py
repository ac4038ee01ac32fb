"""The figure of a fitted mount: its residuals, and the floor before and after."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sofjax.cli.calibrate_mount import Calibration
    from sofjax.io.drive import Drive


def draw(path: Path, drive: "Drive", found: "Calibration") -> None:
    """The residuals, and the floor by the old and the new mount."""
    import numpy as np

    from sofjax import viewer

    if not viewer.available():
        print(viewer.MISSING)
        return
    valid = np.asarray(found.fit.pairs.valid)
    if not valid.any():
        return
    old, new = _residuals(drive, found)
    floors, extent = _floors(drive, found)
    title = f"{drive.name}: {found.verdict}"
    viewer.draw_mount(path, title, old[valid], new[valid], floors, extent)
    print(f"drawn to {path}")


def _residuals(drive: "Drive", found: "Calibration"):
    """[N, 4] pixels by the old and the new mount, the odometer as it was found."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from sofjax.calibration.pairs import Estimate, all_distances

    with jax.enable_x64(True):
        files = (drive.camera_file, found.camera_file)
        cameras = [
            jax.tree.map(lambda a: jnp.asarray(np.asarray(a), float), (file.camera, file.mount))
            for file in files
        ]
        return [
            np.asarray(all_distances(camera, Estimate(mount, found.fit.fit.odometer),
                                     found.fit.pairs))
            for camera, mount in cameras
        ]  # fmt: skip


def _floors(drive: "Drive", found: "Calibration"):
    """Two images a stretch of the way apart on the floor, by the old and the new mount."""
    import numpy as np

    from sofjax.vision import Frontend, read_image, rectify

    height = float(found.camera_file.mount.height)
    at = drive.odometry.at(drive.image_stamps)
    first, second = _apart(at, 0.8 * height)
    frontend = Frontend(drive.camera_file)
    c, s = np.cos(at.yaw[first]), np.sin(at.yaw[first])
    x, y = np.array([[c, s], [-s, c]]) @ (at.xy[second] - at.xy[first])
    motion = np.array([x, y, at.yaw[second] - at.yaw[first]])
    extent = (1.2 * height, 6.0 * height, -2.0 * height, 2.0 * height)
    floors = []
    for mount in (drive.camera_file.mount, found.camera_file.mount):
        both = []
        for i, T in ((first, np.zeros(3)), (second, motion)):
            image = read_image(drive.image_files[i])
            if image is not None:
                image = frontend.undistort(image)
                both.append(rectify(image, drive.camera_file.camera, mount, T, extent))
        floors.append(both)
    return floors, extent


def _apart(at, distance: float) -> tuple[int, int]:
    """The straightest stretch of about that length."""
    import numpy as np

    second = np.searchsorted(at.travelled, at.travelled + distance)
    first = np.flatnonzero(second < len(at.travelled))
    if not len(first):
        return 0, len(at.travelled) - 1
    bend = [np.ptp(at.yaw[i : second[i] + 1]) for i in first]
    i = int(first[int(np.argmin(bend))])
    return i, int(second[i])
