"""Simulated worlds and runs that several tests share, each made once."""

from functools import cache

import numpy as np

from sofjax.geometry import Mount
from sofjax.simulation import (
    WORLDS,
    RobotSetup,
    make_world,
    simulate_run,
    webcam,
)

SAMPLES = [(name, 0) for name in sorted(WORLDS)] + [("random", seed) for seed in range(1, 6)]


@cache
def world_of(name, seed=0):
    return make_world(name, seed)


@cache
def run_of(name, seed=0):
    still = RobotSetup(vibration=0.0, dropped=0.0)
    return simulate_run(world_of(name, seed), still, seed)


def office_camera():
    """The lens and mount of the sample drive."""
    mount = Mount.create(height=0.6, pitch=0.2618, x=0.05)
    return webcam(mount, focal=270.0, distortion=(-0.14, 0.05, 0.0003, 0.0005, 0.0))


def numpy_pose(camera_file, xy, yaw):
    """R_world_camera and C by the book: Rz Ry Rx A, plain numpy."""
    mount = {
        k: float(getattr(camera_file.mount, k))
        for k in ("x", "y", "height", "pitch", "roll", "yaw")
    }

    def rotation(axis, angle):
        c, s = np.cos(angle), np.sin(angle)
        i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
        R = np.eye(3)
        R[i, i] = R[j, j] = c
        R[i, j], R[j, i] = -s, s
        return R

    A = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float)
    Rz = rotation("z", yaw)
    R = (
        Rz
        @ rotation("z", mount["yaw"])
        @ rotation("y", mount["pitch"])
        @ rotation("x", mount["roll"])
        @ A
    )
    return R, np.array([*xy, 0]) + Rz @ [mount["x"], mount["y"], mount["height"]]


def project(camera_file, R, C, points):
    """Pixels of world points [n, 3] through the lens, and their depths."""
    local = (points - C) @ R
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    k1, k2, p1, p2, k3 = camera_file.distortion
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    K = np.asarray(camera_file.camera.K, float)
    return np.stack([K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2]], axis=1), local[:, 2]


def behind_a_wall(world, nadir, points, margin=0.05):
    """[n] whether the straight way from the camera's nadir to a plan point crosses a wall.

    The last `margin` metres of the way do not count: the wall that the point is on.
    """

    def side(p, q, r):
        u, v = q - p, r - p
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

    rays = points - nadir
    ends = nadir + rays * (1 - margin / np.linalg.norm(rays, axis=1, keepdims=True))
    a, b = world.walls[:, 0], world.walls[:, 1]
    ends = ends[:, None]
    apart = side(a, b, ends) * side(a, b, nadir) < 0
    return (apart & (side(nadir, ends, a) * side(nadir, ends, b) <= 0)).any(1)
