"""Two witnesses: without sightings, and against sightings that tell nothing, the odometer's path.

A hundred simulated drives whose segments are (a) random in each image, (b) those of one image in
all of them, (c) those of another drive.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from simulated import world_of

from sofjax.extraction.observation import Observation
from sofjax.geometry import SE2, Segments
from sofjax.motion import MotionModel, adapt_odometer
from sofjax.simulation import WORLDS, RobotSetup, Scene, observe, random_setup, simulate_run
from sofjax.slam import SlamConfig, SofSlam
from sofjax.slam.config import FilterConfig
from sofjax.slam.presets import PAPER

T, M, N = 200, 48, 300  # images, segments an image, particles
FEW, MANY = 24, 100  # drives
EDGES, WALLS = 2048, 64
CONFIG = SlamConfig(filter=FilterConfig(particles=N))
CAMERA, MOUNT = RobotSetup().camera_file.camera, RobotSetup().camera_file.mount


@functools.cache
def drive(i):
    """True places [T, 2] and observations of one of the drives: odometers and worlds differ."""
    world = world_of(sorted(WORLDS)[i % len(WORLDS)], i)
    setup = RobotSetup(odometer=random_setup(i).odometer)
    run = simulate_run(world, setup, i, max_images=T)
    scene, key = Scene.of(world, EDGES, WALLS), jax.random.key(i)
    seen = jax.jit(observe, static_argnames="capacity")
    log = seen(scene, CAMERA, run.mounts, run.poses(), run.motions(), key, capacity=M)
    return run.truth.xy, jax.tree.map(np.asarray, log)


@functools.cache
def drives(count):
    xy, logs = zip(*(drive(i) for i in range(count)), strict=True)
    return np.stack(xy), jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *logs)


def spoilt(kind, log):
    """The odometer's readings with segments that tell nothing of them."""
    segments, shape = log.segments_image, log.segments_image.endpoints.shape
    if kind == "random":
        rng = np.random.default_rng(3)
        begin = rng.uniform([0, 80], [CAMERA.width, CAMERA.height], (*shape[:3], 2))
        ends = np.stack([begin, begin + rng.normal(0, 30, begin.shape)], axis=3)
        segments = Segments(jnp.asarray(ends, float), segments.valid)
    elif kind == "constant":
        segments = jax.tree.map(lambda a: jnp.broadcast_to(a[:, 30:31], a.shape), segments)
    else:
        segments = jax.tree.map(lambda a: jnp.roll(a, 7, axis=0), segments)
    return Observation(segments, log.motion, log.overflow)


@functools.cache
def runner(config=CONFIG):
    start = SofSlam(config, CAMERA, MOUNT).init(jax.random.key(0), M)
    return jax.jit(jax.vmap(lambda log: SofSlam(config, CAMERA, MOUNT).run(start, log)[1]))


def paths(log, size=8):
    """Of the filter and of the odometer alone, [drives, T, 2]."""
    by_odometer = lambda motion: jax.lax.scan(lambda T, m: (T @ m,) * 2, SE2.identity(), motion)[1]
    parts = [
        np.asarray(runner()(jax.tree.map(lambda a, i=i: a[i : i + size], log)).T_world_robot.xy)
        for i in range(0, len(log.overflow), size)
    ]
    return np.concatenate(parts), np.asarray(jax.vmap(by_odometer)(log.motion).xy)


def trajectory_error(truth, xy):
    """Root mean square after the best rigid motion, metres; places as complex numbers."""
    a, b = (p[..., 0] + 1j * p[..., 1] for p in (xy.astype(float), truth))
    a, b = a - a.mean(), b - b.mean()
    turn = np.vdot(a, b)
    return np.sqrt(np.mean(abs(b - turn / abs(turn) * a) ** 2))


def relative_errors(kind, count):
    """Of the filter, as multiples of the odometer's."""
    truth, log = drives(count)
    by_filter, by_odometer = paths(log if kind == "true" else spoilt(kind, log))
    of = lambda path: np.array([trajectory_error(*both) for both in zip(truth, path, strict=True)])
    return of(by_filter) / of(by_odometer)


def test_without_sightings_the_estimate_is_the_odometer_s_path():
    _, log = drives(8)
    nothing = Segments(log.segments_image.endpoints, jnp.zeros_like(log.segments_image.valid))
    by_filter, by_odometer = paths(Observation(nothing, log.motion, log.overflow))
    np.testing.assert_allclose(by_filter, by_odometer, atol=1e-4)


TOLD = [("random", 1.001, 1.01), ("constant", 1.02, 3.0), ("other", 1.15, 10.0)]


def test_good_sightings_are_used():
    assert np.median(relative_errors("true", FEW)) < 0.6


@pytest.mark.parametrize(("kind", "median", "most"), TOLD)
def test_sightings_that_tell_nothing_leave_it_to_the_odometer(kind, median, most):
    error = relative_errors(kind, FEW)
    assert np.median(error) < median
    assert np.quantile(error, 0.9) < most


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "median", "most"), TOLD)
def test_of_a_hundred_drives_sightings_that_tell_nothing_spoil_none_much(kind, median, most):
    error = relative_errors(kind, MANY)
    assert np.median(error) < median
    assert np.quantile(error, 0.9) < most


def test_the_paper_trusts_every_image():
    assert not PAPER.filter.doubts and PAPER.motion.adaptation == 0


def test_an_inflation_of_the_odometer_s_noise_finds_the_noise_that_there_is(rng):
    """Draws of one standard deviation, where the noise has four: the variance inflates to 16."""
    inflation, prior = jnp.ones(2), jnp.full(2000, 1 / 2000)
    for _ in range(300):
        draws = rng.normal(size=(2000, 2))
        true = 4 * rng.normal(size=2)
        off = (draws * np.sqrt(inflation) - true) / 0.5
        weight = np.exp(-0.5 * (off**2).sum(1) + 0.5 * (off**2).sum(1).min())
        inflation = adapt_odometer(
            MotionModel(), inflation, prior, jnp.asarray(weight / weight.sum(), float),
            jnp.asarray(draws, float), jnp.array(True),
        )  # fmt: skip
    assert (6 < inflation).all() and (inflation < 40).all()


def test_where_nothing_is_told_the_odometer_s_inflation_stays_and_without_a_witness_it_fades(rng):
    draws, even = jnp.asarray(rng.normal(size=(100, 2)), float), jnp.full(100, 0.01)
    of = lambda sound: adapt_odometer(
        MotionModel(), jnp.array([3.0, 20.0]), even, even, draws, jnp.array(sound)
    )
    np.testing.assert_allclose(of(True), [3, 20], rtol=1e-6)
    assert (of(False) < jnp.array([3.0, 20.0])).all() and (of(False) >= 1).all()
