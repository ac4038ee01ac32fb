"""A robot that drives past lines of the floor and sees their ends: plain NumPy, no detector."""

from functools import cache
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from simulated import numpy_pose

from sofjax.extraction import Observation
from sofjax.extraction.observation import LAGS
from sofjax.geometry import SE2, Camera, Mount, Segments
from sofjax.io.trajectory import Trajectory
from sofjax.rig import RIG, Lens, Rig

IMAGES, CAPACITY, RATE = 140, 24, 10.0
NOISE = 0.1  # pixels, of an end


@cache
def path(turns=True):
    """Some 8 m in 14 s, a pose every 5 ms: straight parts and turns both ways, or steadily on."""
    t = np.arange(-1.0, IMAGES / RATE + 1, 0.005)
    speed, rate = 0.6 + 0 * t, 0 * t
    if turns:
        speed = 0.55 + 0.25 * np.sin(1.7 * t)
        bend = np.sin(2 * np.pi * t / 7)
        rate = np.where(np.abs(bend) > 0.35, 0.7 * np.sign(bend) * (np.abs(bend) - 0.35), 0)
    yaw = np.cumsum(rate) * 0.005
    step = speed * 0.005
    xy = np.cumsum(np.stack([step * np.cos(yaw), step * np.sin(yaw)], axis=1), axis=0)
    return Trajectory(t, xy, yaw)


@cache
def floor(turns=True, count=160):
    """[count, 2, 2] lines beside the path and across it, metres."""
    rng = np.random.default_rng(11)
    at = path(turns).at(rng.uniform(0.5, IMAGES / RATE + 5, count))
    last = at.xy + 3.0 * (at.stamps > IMAGES / RATE)[:, None] * np.stack(
        [np.cos(at.yaw), np.sin(at.yaw)], axis=1
    ) * rng.uniform(0, 1, (count, 1))
    side = rng.uniform(-0.9, 0.9, count)[:, None] * np.stack([-np.sin(at.yaw), np.cos(at.yaw)], 1)
    angle = at.yaw + rng.uniform(0, np.pi, count)
    along = rng.uniform(0.1, 0.25, count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    middle = last + side
    return np.stack([middle - along, middle + along], axis=1)


def given_rig():
    """As the file says: 320x240 pixels, 60 cm over the floor."""
    K = np.array([[270.0, 0, 159.5], [0, 270.0, 119.5], [0, 0, 1]])
    lens = Lens.of(np.array([-0.14, 0.05, 0.0003, 0.0005, 0.0]))
    mount = Mount(*map(jnp.asarray, (0.05, 0.0, 0.6, 0.26, 0.0, 0.0)))
    return Rig(Camera(jnp.asarray(K), 320, 240), mount, lens)


def right_rig(**by):
    """Other than the file says by so much of each of `RIG`."""
    return given_rig().moved(jnp.array([by.get(name, 0.0) for name in RIG]))


@jax.jit
def undistorted(rig, raw):
    """Pixels [n, 2] as the camera took them, in the image that `rig`'s lens undistorts."""
    K = rig.camera.K

    def one(x):
        d = (x - K[:2, 2]) / jnp.diag(K)[:2]
        for _ in range(5):
            d = rig.lens.undistort((x - K[:2, 2]) / jnp.diag(K)[:2], near=d)
        return K[:2, :2] @ d + K[:2, 2]

    return jax.vmap(one)(raw)


def drive(turns=True, noise=NOISE, **by):
    """The log of a robot whose rig is other than the file says; float64.

    The time offset is added to a stamp: that is when the image was taken.
    """
    given, right = given_rig(), right_rig(**by)
    stamps = np.arange(IMAGES) / RATE
    read, true = path(turns), path(turns).at(stamps + float(right.time_offset))
    rng = np.random.default_rng(5)
    lines = floor(turns)
    ends = np.zeros((IMAGES, CAPACITY, 2, 2))
    valid = np.zeros((IMAGES, CAPACITY), bool)
    points = np.concatenate([lines, np.zeros((len(lines), 2, 1))], axis=2).reshape(-1, 3)
    K = np.asarray(right.camera.K)
    for i in range(IMAGES):
        R, C = numpy_pose(SimpleNamespace(mount=right.mount), true.xy[i], true.yaw[i])
        x = (points - C) @ R
        n = x[:, :2] / np.where(x[:, 2:] > 0.3, x[:, 2:], 1)
        pixels = n @ K[:2, :2].T + K[:2, 2]
        seen = (x[:, 2] > 0.3) & (x[:, 2] < 4) & ((pixels > 5) & (pixels < [315, 235])).all(1)
        both = np.flatnonzero(seen.reshape(-1, 2).all(1))[:CAPACITY]
        ends[i, : len(both)] = n.reshape(-1, 2, 2)[both]
        valid[i, : len(both)] = True
    raw = K[:2, :2] @ np.asarray(jax.vmap(right.lens.distort)(jnp.asarray(ends.reshape(-1, 2)))).T
    raw = raw.T + K[:2, 2] + rng.normal(0, noise, (ends.size // 2, 2))
    seen = np.asarray(undistorted(given, jnp.asarray(raw))).reshape(ends.shape)
    return Observation(
        Segments(jnp.asarray(seen), jnp.asarray(valid)),
        *_read(read, stamps),
    )


def _read(path, stamps):
    """What the odometer says at the stamps: motions, no overflow, no doubt, and the ways around."""
    pose = lambda at: SE2(jnp.asarray(at.xy), jnp.asarray(at.yaw))
    here = path.at(stamps)
    before = path.at(np.append(stamps[0], stamps[:-1]))
    motion = jax.vmap(lambda a, b: a.between(b))(pose(before), pose(here))
    around = np.stack([
        jax.vmap(lambda a, b: a.between(b).log())(pose(here), pose(path.at(stamps + lag)))
        for lag in LAGS
    ], axis=1)  # fmt: skip
    return motion, jnp.zeros(len(stamps), int), None, jnp.asarray(around)
