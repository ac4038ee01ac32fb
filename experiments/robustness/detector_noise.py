"""How well a line detector finds the true floor segments of a drive, seen from the true poses.

    python detector_noise.py DRIVE [DRIVE ...] [--detector lsd|hough] [--every N]

Segments within 5 m are put on the floor by the written camera and the true pose. One counts as
right if a true segment lies within 10 cm and 5 degrees of it, and its error is its middle's
distance from that line (rho) and the angle between them (theta). A true segment's sample, one
every 5 cm, counts as found if a right segment passes within 5 cm; those behind walls, out of the
picture or farther than 5 m do not count.
"""

import argparse
from pathlib import Path

import numpy as np

from sofjax.geometry import rotation_robot_camera
from sofjax.io.drive import Drive, read_drive
from sofjax.vision import DETECTORS, Lens, read_image

RANGE = 5.0  # metres


def floor_homography(drive: Drive, pose: np.ndarray) -> np.ndarray:
    """H_F of one true pose (x, y, yaw) in numpy, from the world's floor to the image."""
    mount, K = drive.camera_file.mount, np.asarray(drive.camera_file.camera.K, float)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    Rz = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    R = (Rz @ np.asarray(rotation_robot_camera(mount), float)).T
    arm = Rz @ [float(mount.x), float(mount.y), float(mount.height)]
    P = K @ np.column_stack([R, -R @ (arm + np.append(pose[:2], 0))])
    return P[:, [0, 1, 3]]


def on_floor(H_F: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Image segments [S, 4] on the floor [S', 2, 2], their part nearer than `RANGE`."""
    inverse = np.linalg.inv(H_F)
    found = []
    for segment in segments.reshape(-1, 2, 2):
        X = np.column_stack([segment, np.ones(2)]) @ inverse.T
        f = X[:, 2] - 1 / RANGE
        if (f <= 0).all():
            continue
        for i in (0, 1):
            if f[i] < 0:
                X[i] = X[i] + f[i] / (f[i] - f[1 - i]) * (X[1 - i] - X[i])
        found.append(X[:, :2] / X[:, 2:])
    return np.array(found).reshape(-1, 2, 2)


def differences(found: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[S, F] distance of the middle of `found` from each true segment, and the angle, radians."""
    d = truth[:, 1] - truth[:, 0]
    length = np.linalg.norm(d, axis=1)
    unit = d / length[:, None]
    middle = found.mean(1)
    away = middle[:, None] - truth[None, :, 0]
    along = np.clip((away * unit).sum(-1), 0, length)
    distance = np.linalg.norm(away - along[..., None] * unit, axis=-1)
    angle = np.arctan2(*(found[:, 1] - found[:, 0]).T[::-1])[:, None] - np.arctan2(d[:, 1], d[:, 0])
    return distance, np.abs((angle + np.pi / 2) % np.pi - np.pi / 2)


def visible(
    H_F: np.ndarray, size: tuple, nadir: np.ndarray, points: np.ndarray, walls: np.ndarray
) -> np.ndarray:
    """Which floor points [n, 2] are in the picture, near enough and not behind a wall."""
    x = np.column_stack([points, np.ones(len(points))]) @ H_F.T
    depth = np.where(x[:, 2] > 0.1, x[:, 2], np.inf)
    u, v = x[:, 0] / depth, x[:, 1] / depth
    ok = (
        (x[:, 2] > 0.1)
        & (x[:, 2] < RANGE)
        & (u > 0)
        & (v > 0)
        & (u < size[0] - 1)
        & (v < size[1] - 1)
    )
    for a, b in walls:

        def side(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
            return (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (
                r[..., 0] - p[..., 0]
            )

        near = points + 0.05 * (nadir - points) / np.linalg.norm(
            nadir - points, axis=1, keepdims=True
        )
        crosses = (side(a, b, near) * side(a, b, nadir) < 0) & (
            side(nadir, near, a[None]) * side(nadir, near, b[None]) < 0
        )
        ok &= ~crosses
    return ok


def measure(path: Path, detector: str, every: int) -> dict[str, float]:
    drive = read_drive(path)
    truth = drive.floor_segments
    kinds = [
        line.split(",")[4].strip() for line in open(path / "floor_segments.csv") if line[0] != "#"
    ]
    walls = truth[[kind == "wall" for kind in kinds]]
    samples = []
    for a, b in truth:
        n = max(1, int(np.linalg.norm(b - a) / 0.05))
        samples.append(np.column_stack([a + ((np.arange(n) + 0.5) / n)[:, None] * (b - a)]))
    samples = np.concatenate(samples)
    lens, camera = Lens(drive.camera_file), drive.camera_file.camera
    at = drive.groundtruth.at(drive.image_stamps)
    rho, theta, seen, hit, right, total = [], [], 0, 0, 0, 0
    for i in range(0, len(drive.image_files), every):
        image = lens.undistort(read_image(drive.image_files[i]))
        grey = image if image.ndim == 2 else image @ np.array([0.114, 0.587, 0.299])
        segments = DETECTORS[detector](np.ascontiguousarray(np.round(grey).astype(np.uint8)))
        H_F = floor_homography(drive, np.array([*at.xy[i], at.yaw[i]]))
        found = on_floor(H_F, segments)
        if not len(found):
            continue
        distance, angle = differences(found, truth)
        distance = np.where(angle < np.deg2rad(5), distance, np.inf)
        best = distance.argmin(1)
        good = distance.min(1) < 0.1
        rows = np.flatnonzero(good)
        rho += list(distance[rows, best[rows]])
        theta += list(angle[rows, best[rows]])
        total, right = total + len(found), right + len(rows)
        in_view = samples[visible(H_F, (camera.width, camera.height), at.xy[i], samples, walls)]
        if len(rows) and len(in_view):
            ends = found[rows]
            d = ends[:, 1] - ends[:, 0]
            s = ((in_view[:, None] - ends[:, 0]) * d).sum(-1) / (d**2).sum(-1)
            gap = np.linalg.norm(
                in_view[:, None] - ends[:, 0] - np.clip(s, 0, 1)[..., None] * d, axis=-1
            )
            hit += int((gap.min(1) < 0.05).sum())
        seen += len(in_view)
    return {
        "rho_cm": 100 * float(np.median(rho)),
        "theta_deg": float(np.degrees(np.median(theta))),
        "right": right / max(total, 1),
        "found": hit / max(seen, 1),
        "segments": total / len(range(0, len(drive.image_files), every)),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("drives", metavar="DRIVE", nargs="+", type=Path)
    parser.add_argument("--detector", choices=sorted(DETECTORS), default="lsd")
    parser.add_argument("--every", type=int, default=5)
    args = parser.parse_args()
    for path in args.drives:
        figures = measure(path, args.detector, args.every)
        print(path.name, *(f"{name} {value:.3f}" for name, value in figures.items()), sep="  ")
