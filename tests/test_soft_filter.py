"""The filter's evidence as a density: normalised, smooth, with a derivative through a drive."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
import test_slam
from conftest import jit_quickly
from test_likelihood import as_arrays, random_problem

from sofjax import SofSlam
from sofjax.extraction.association import Association, gate_probability
from sofjax.geometry import SE2, Segments
from sofjax.likelihood.density import log_density
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.motion import OdometerBias
from sofjax.particles import Particles, systematic
from sofjax.slam.presets import DEFAULT

pytestmark = pytest.mark.usefixtures("x64")

T, N, K = 16, 16, 64
RULES = dataclasses.replace(
    DEFAULT.filter, particles=N, soft=True, gate_each=True, effective_share=0.0
)
CONFIG = dataclasses.replace(
    DEFAULT, filter=RULES, segment_map=dataclasses.replace(DEFAULT.segment_map, capacity=K)
)
# the soft filter keeps the noise that it is given, and the drive turns to the left alone
NOT_READ = ("adaptation", "noise_max", "right_error")
VARIABLES = (
    *(("association", name) for name in ("alpha", "beta", "gate", "temperature")),
    *(("motion", f.name) for f in dataclasses.fields(CONFIG.motion) if f.name not in NOT_READ),
    *(("sensor", name) for name in ("pixel_sigma", "tilt_sigma")),
)


def evidence(settings, mount, camera, observations):
    """Summed over a drive, with what the filter said and the state before the first image."""
    where = lambda c: [getattr(getattr(c, part), name) for part, name in VARIABLES]
    config = eqx.tree_at(where, CONFIG, list(settings))
    slam = SofSlam(config, camera, mount)
    start = slam.init(jax.random.key(0), test_slam.M)
    _, info = slam.run(start, observations)
    return info.log_evidence.sum(), info


@functools.cache
def differentiated():
    """The program, made once, and its arguments: numbers to vary and the drive."""
    to_float64 = lambda a: a.astype(float) if a.dtype == "float32" else a
    camera, mount, observations = jax.tree.map(
        to_float64,
        (test_slam.CAMERA, test_slam.MOUNT, jax.tree.map(lambda a: a[:T], test_slam.drive()[1])),
    )
    settings = jnp.array([getattr(getattr(CONFIG, part), name) for part, name in VARIABLES])
    flat, unravel = jax.flatten_util.ravel_pytree((settings, mount))

    def f(x, observations):
        return evidence(*unravel(x), camera, observations)

    with jax.numpy_dtype_promotion("standard"):  # indices of top_k stay int32
        program = jit_quickly(jax.value_and_grad(f, has_aux=True)).lower(flat, observations)
    return program.compile(), flat, observations


def test_the_gradient_of_a_drive_s_evidence_is_that_of_differences():
    """By settings and mount, the random numbers fixed and nothing resampled."""
    program, at, observations = differentiated()
    (value, info), gradient = program(at, observations)
    assert np.isfinite(value) and info.matched[-4:].min() > 3
    assert info.effective_size[-1] < N / 2  # the weights matter
    steps = 3e-5 * np.diag(np.maximum(np.abs(at), 0.01))
    expected = [
        (program(at + step, observations)[0][0] - program(at - step, observations)[0][0])
        / (2 * step.sum())
        for step in steps
    ]
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-3)
    assert (np.abs(gradient) > 1e-4).all()


def test_what_is_too_vague_to_be_used_counts_as_anywhere_in_the_image():
    """Else a sigma that leaves all segments out would be the likeliest."""
    program, at, observations = differentiated()
    (usual, _), _ = program(at, observations)
    undetermined = at.at[VARIABLES.index(("sensor", "pixel_sigma"))].set(100.0)
    (value, info), _ = program(undetermined, observations)
    assert info.below_horizon.sum() == 0 < info.detected.sum()
    pixels = test_slam.CAMERA.width * test_slam.CAMERA.height
    assert value == pytest.approx(-np.log(pixels) * int(info.detected.sum()), rel=1e-6)
    assert usual > value


def test_the_gradient_keeps_a_state_a_step_and_works_the_rest_out_again():
    program, *_ = differentiated()
    state = jax.eval_shape(
        lambda: SofSlam(CONFIG, test_slam.CAMERA, test_slam.MOUNT).init(
            jax.random.key(0), test_slam.M
        )
    )
    state = sum(a.size for a in jax.tree.leaves(state)) * 8
    pairs = N * test_slam.M * CONFIG.segment_map.candidates * 8
    # one step takes about 120 numbers for each pair; all of them kept would be ten times as much
    assert program.memory_analysis().temp_size_in_bytes < T * state + 160 * pairs


def test_the_gradient_is_finite_where_nothing_is_seen():
    program, at, observations = differentiated()
    for blank in (0, 1):  # no segments at all; all of them one point
        ends = observations.segments_image.endpoints * 0 + 160.0 * blank
        valid = observations.segments_image.valid & bool(blank)
        dark = dataclasses.replace(observations, segments_image=Segments(ends, valid))
        (value, _), gradient = program(at, dark)
        assert np.isfinite(value) and np.isfinite(gradient).all()


# The density of one image


SENSOR = SensorModel(tilt_sigma=0.01)
CERTAIN = 1 - 1e-12


def density(measurements, candidates, known, lines=1.0, elsewhere=-11.0, sensor=SENSOR):
    known, lines, elsewhere = (jnp.asarray(a, float) for a in (known, lines, elsewhere))
    known = jnp.broadcast_to(known, measurements.valid.shape)
    return log_density(sensor, measurements, candidates, SE2.identity(), known, lines, elsewhere)


def test_lines_that_are_certain_have_the_density_of_one_gaussian(rng):
    """All errors of an image together: their own covariances and what the jitter makes alike."""
    near, lines, apparent_scale, W, _ = random_problem(rng)
    lines, apparent_scale, W = lines[:, :1], apparent_scale[:, :1], W[:, :1]
    near = lines[:, 0] + rng.normal(0, 0.02, size=near.shape)
    J = rng.normal(size=(len(near), 2, 2))
    arrays = as_arrays(
        near, lines, apparent_scale, W, np.ones((len(near), 1), bool), J, SENSOR.tilt_sigma
    )
    found = density(*arrays, known=CERTAIN, lines=5.0, elsewhere=-1e3)
    S = np.zeros((2 * len(near),) * 2)
    for m, precision in enumerate(W[:, 0]):
        S[2 * m : 2 * m + 2, 2 * m : 2 * m + 2] = np.linalg.inv(precision)
    tall = J.reshape(-1, 2)
    S += SENSOR.tilt_sigma**2 * tall @ tall.T
    d = (near - lines[:, 0]).reshape(-1)
    expected = -0.5 * (d @ np.linalg.solve(S, d) + np.linalg.slogdet(2 * np.pi * S)[1])
    assert found == pytest.approx(expected - len(near) * np.log(5.0), rel=1e-9)


def test_segments_that_are_no_line_have_the_density_of_the_image(rng):
    measurements, candidates = as_arrays(*random_problem(rng))
    M = len(measurements.valid)
    assert density(measurements, candidates, known=0.0, elsewhere=-11.0) == pytest.approx(-11.0 * M)


def test_a_line_seen_twice_as_large_in_the_image_is_twice_as_improbable_a_pixel(rng):
    measurements, candidates = as_arrays(*random_problem(rng))
    larger = dataclasses.replace(
        measurements, log_area=jnp.full(len(measurements.valid), np.log(2.0))
    )
    many = density(larger, candidates, CERTAIN, elsewhere=-1e7)
    once = density(measurements, candidates, CERTAIN, elsewhere=-1e7)
    met = np.asarray(candidates.valid).any(axis=1).sum()
    assert many - once == pytest.approx(met * np.log(2.0), rel=1e-6)


def test_the_density_of_a_true_sigma_is_the_highest(rng):
    """What the error without its constant cannot tell: there the largest sigma wins."""
    M, true = 4000, 0.02
    lines = np.stack([rng.normal(size=(M, 1)), rng.uniform(-1, 1, size=(M, 1))], -1)
    near = lines[:, 0] + rng.normal(0, true, size=(M, 2))

    def of(sigma):
        W = np.broadcast_to(np.eye(2) / sigma**2, (M, 1, 2, 2))
        return density(*as_arrays(near, lines, np.ones((M, 1)), W, np.ones((M, 1), bool)), 0.5)

    tried = true * np.array([0.8, 0.9, 1.0, 1.1, 1.25])
    assert np.argmax([of(sigma) for sigma in tried]) == 2


def test_the_soft_gate_worked_by_hand():
    config = Association(gate=6.0, temperature=2.0)
    found = gate_probability(config, jnp.array([6.0, 2.0, 60.0, jnp.inf]))
    np.testing.assert_allclose(found, [0.5, 1 / (1 + np.exp(-2)), 1 / (1 + np.exp(27)), 0])
    nothing = jnp.full(2, jnp.inf)
    slope = jax.grad(lambda error: gate_probability(config, error).sum())
    np.testing.assert_array_equal(slope(nothing), 0)


# Resampling


def test_credited_choices_have_the_derivative_of_the_mean_that_they_estimate(rng):
    """The mean of g over resampled particles is in the mean sum w g; so must its derivative be."""
    a, g = jnp.asarray(rng.normal(size=8)), jnp.asarray(rng.normal(size=8))
    weights = lambda t: jax.nn.log_softmax(t * a)

    def estimate(t, key, credit):
        bias = OdometerBias(jnp.zeros((8, 4)), jnp.eye(4))
        particles = Particles(SE2(jnp.stack([g, g], 1), g), bias, weights(t))
        chosen = particles.take(
            systematic(jax.random.uniform(key), jax.lax.stop_gradient(weights(t))), credit
        )
        return jnp.exp(chosen.log_weight) @ chosen.T_world_robot.yaw

    keys = jax.random.split(jax.random.key(1), 4000)
    slopes = jax.vmap(jax.grad(estimate), in_axes=(None, 0, None))(0.7, keys, True)
    expected = float(jax.grad(lambda t: jnp.exp(weights(t)) @ g)(0.7))
    error = float(slopes.std()) / np.sqrt(len(keys))
    assert slopes.mean() == pytest.approx(expected, abs=5 * error)
    assert abs(expected) > 20 * error
    assert jax.grad(estimate)(0.7, keys[0], False) == 0
