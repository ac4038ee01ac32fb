"""Pairs of measurements of lines of the floor, exact or noisy, and the fit to them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from conftest import jit_quickly

from sofjax.calibration import (
    UNKNOWNS,
    FitConfig,
    PairNoise,
    Seen,
    SegmentPairs,
    distances,
    expected,
    fit_rig,
    start_at,
)
from sofjax.geometry import SE2, Mount, projection_matrix
from sofjax.rig import Rig

N = 96
MOUNT = (0.05, 0.0, 0.6, 0.26, 0.02, 0.0)  # x, y, height, pitch, roll, yaw


def begin(camera, mount):
    return start_at(Rig(camera, mount))


def fit_from(camera, mount, pairs, config=None):
    """A fit that begins at a mount, everything else of the rig as it is; compiled well."""
    return fit_rig(begin(camera, mount), pairs, config or FitConfig())


fit_mount = jit_quickly(fit_from)


def changes(**by):
    """A change [17] of some of the unknowns, by name."""
    return jnp.array([by.pop(name, 0.0) for name in UNKNOWNS])


def off_by(estimate, first, second, T):
    """The distances of one pair, whose images were taken at their stamps by the given lens."""
    return distances(estimate, Seen(first, second, T))


FIT = {"height": 0.6, "pitch": 0.26, "roll": 0.02}


def true_mount():
    return Mount(*map(jnp.asarray, MOUNT))


def off(mount, times=1.0, pitch=0.0, roll=0.0):
    return eqx.tree_at(
        lambda m: (m.height, m.pitch, m.roll),
        mount,
        (mount.height * times, mount.pitch + pitch, mount.roll + roll),
    )


def seen(camera, mount, pose, points):
    """World points [N, 2, 3] in an image, pixels, by the plain projection."""
    P = np.asarray(
        projection_matrix(camera, mount, SE2(jnp.asarray(pose[:2]), jnp.asarray(pose[2])))
    )
    x = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=-1) @ P.T
    assert (x[..., 2] > 0).all()
    return x[..., :2] / x[..., 2:]


def make_pairs(camera, mount, rng, motion=None, angle=None, noise=0.0, z=0.0):
    """N lines of the floor, each seen before and after a motion of its own."""
    first = np.stack(
        [rng.uniform(-0.2, 0.2, N), rng.uniform(-0.1, 0.1, N), rng.uniform(-1, 1, N)], 1
    )
    if motion is None:
        motion = np.stack(
            [rng.uniform(0.3, 0.9, N), rng.normal(0, 0.02, N), rng.normal(0, 0.05, N)], axis=1
        )
    T1 = SE2(jnp.asarray(first[:, :2]), jnp.asarray(first[:, 2]))
    T12 = SE2(jnp.asarray(motion[:, :2]), jnp.asarray(motion[:, 2]))
    T2 = T1 @ T12
    middle = np.stack([rng.uniform(1.7, 4, N), rng.uniform(-0.8, 0.8, N)], axis=1)
    angle = rng.uniform(0, np.pi, N) if angle is None else angle
    along = rng.uniform(0.15, 0.4, N)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ends = np.asarray(T1.apply(jnp.asarray(np.stack([middle - along, middle + along])))).swapaxes(
        0, 1
    )
    height = np.broadcast_to(z, N)[:, None, None] * np.ones((N, 2, 1))
    points = np.concatenate([ends, height], axis=-1)
    images = []
    for T in (T1, T2):
        poses = np.concatenate([np.asarray(T.xy), np.asarray(T.yaw)[:, None]], axis=1)
        images.append(np.concatenate([
            seen(camera, mount, pose, point[None])
            for pose, point in zip(poses, points, strict=True)
        ]))  # fmt: skip
    images = [image + rng.normal(0, noise, image.shape) for image in images]
    return SegmentPairs(
        *map(jnp.asarray, images), T12, jnp.ones(N, bool), jnp.ones((N, 4)), jnp.arange(N)
    )


def weighed(camera, mount, pairs, **noise):
    return eqx.tree_at(
        lambda p: p.sigma, pairs, expected(PairNoise(**noise), begin(camera, mount), pairs)
    )


def value(result):
    return np.array([result.mount.height, result.mount.pitch, result.mount.roll])
