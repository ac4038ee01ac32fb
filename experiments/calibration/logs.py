"""Drives seen as segments of the floor, for the studies of the mount; and what they can tell."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sofjax.calibration import Estimate, Seen, SegmentPairs, distances, start_at
from sofjax.extraction import Observation
from sofjax.geometry import SE2, Camera, Mount
from sofjax.motion import MotionModel
from sofjax.rig import Rig
from sofjax.simulation import (
    Detection,
    Odometer,
    Scene,
    World,
    observe,
    random_setup,
    simulate_run,
)

IMAGES = 160
EXACT = Odometer(1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
EXACT_MODEL = MotionModel(*[0.0] * 7)
LSD = Detection(shortening=1.0, broken=0.0, false_segments=0.0, missed=0.05)


def make_log(
    world: World, seed: int, noise: float, odometer: Odometer = EXACT
) -> tuple[Camera, Mount, Observation]:
    """The camera of a random robot setup, at rest on it, its true mount and its log, in float64."""
    setup = dataclasses.replace(random_setup(seed), odometer=odometer, dropped=0.0, vibration=0.0)
    simulated = simulate_run(world, setup, seed, IMAGES)
    scene = Scene.of(world, edges=2048, walls=256)
    scene = eqx.tree_at(
        lambda s: (s.contrast, s.width),
        scene,
        (jnp.where(scene.on_floor, scene.contrast, 0), jnp.zeros_like(scene.width)),
    )
    log = _observe(
        scene, setup.camera_file.camera, simulated.mounts, simulated.poses(), simulated.motions(),
        jax.random.key(seed), dataclasses.replace(LSD, noise=jnp.asarray(noise)),
    )  # fmt: skip
    double = lambda x: jnp.asarray(x, float if x.dtype.kind == "f" else x.dtype)
    tree = (setup.camera_file.camera, setup.camera_file.mount, log)
    return jax.tree.map(lambda x: double(np.asarray(x)), tree)


_observe = jax.jit(observe)


def roughly(mount: Mount) -> Mount:
    """Where the fits begin: 10 % and 1.7° off."""
    return eqx.tree_at(
        lambda m: (m.height, m.pitch), mount, (mount.height * 1.1, mount.pitch + 0.03)
    )


def moved(camera: Camera, mount: Mount, by: jax.Array) -> Estimate:
    """The rig of a camera and a mount, with log height, pitch and roll changed."""
    start = start_at(Rig(camera, mount))
    return start.moved(jnp.zeros_like(start.by).at[:3].set(by))


@eqx.filter_jit
def cramer_rao(camera: Camera, mount: Mount, pairs: SegmentPairs, noise: jax.Array) -> jax.Array:
    """Least standard deviations of (height, pitch, roll) from these pairs, every line unknown."""

    def one(first: jax.Array, second: jax.Array, T: SE2) -> jax.Array:
        of = lambda by, a, b: distances(moved(camera, mount, by), Seen(a, b, T))[:2]
        J, a, b = jax.jacfwd(of, (0, 1, 2))(jnp.zeros(3), first, second)
        by_ends = jnp.concatenate([a.reshape(2, 4), b.reshape(2, 4)], axis=1)
        return J.T @ jnp.linalg.solve(noise**2 * by_ends @ by_ends.T, J)

    each = jax.vmap(one)(pairs.first, pairs.second, pairs.T_first_second)
    information = jnp.sum(jnp.where(pairs.valid[:, None, None], each, 0), axis=0)
    unit = jnp.stack([mount.height, jnp.ones(()), jnp.ones(())])
    return jnp.sqrt(jnp.diag(jnp.linalg.inv(information))) * unit
