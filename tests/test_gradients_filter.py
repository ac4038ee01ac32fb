"""Gradients of the motion model, the sensor model and the map's lines."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import jit_quickly, make_camera
from test_gradients import (
    MOUNT,
    POSE,
    assert_finite,
    assert_right,
    differentiate,
    horizon_row,
    mount_of,
    pose_of,
)

from sofjax.geometry import (
    SE2,
    PolarLine,
    Segments,
)
from sofjax.likelihood.measurements import Measurements, measure
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.likelihood.tracking import Candidates, precompute, score
from sofjax.motion import MotionModel, prior_bias, sample_motion, sample_slip
from sofjax.segment_map import MapConfig, posterior_given_class, predict_measurement

pytestmark = pytest.mark.usefixtures("x64")


def drawn(p):
    model = eqx.tree_at(lambda m: (m.distance_noise, m.turn_noise), MotionModel(), (p[3], p[4]))
    bias = dataclasses.replace(prior_bias(MotionModel()), mean=p[5:9])
    motion, learned, _ = sample_motion(model, bias, SE2.exp(p[:3]), jax.random.key(0))
    return motion, learned.mean, learned.covariance


BELIEF = [0.01, 0.02, 0.01, -0.02, 0.03, 0.002]  # two noises, four systematic errors


@pytest.mark.parametrize("twist", [[0.3, 0.01, 0.2], [0.3, 0.0, -0.2], [-0.2, 0.0, 0.1]])
def test_gradients_of_a_drawn_motion(twist):
    """By the odometer's reading, the noise and the belief: a filter can be tuned by them."""
    assert_right(drawn, [*twist, *BELIEF], rtol=1e-4)


def slipped(p):
    model = eqx.tree_at(lambda m: (m.slip_distance, m.slip_turn), MotionModel(), (p[3], p[4]))
    # some of them try a slip
    return sample_slip(model, SE2.exp(p[:3]), jnp.array(True), jax.random.key(0), 100)


@pytest.mark.parametrize("twist", [[0.3, 0.01, 0.2], [0.0, 0.0, 0.0], [0.0, 0.0, 0.1]])
def test_gradients_of_a_slip_are_finite(twist):
    assert_finite(slipped, [*twist, 0.01, 0.05])


@pytest.mark.parametrize("twist", [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.1]])
def test_gradients_of_a_robot_that_stands_or_does_not_turn_are_finite(twist):
    assert_finite(drawn, [*twist, *BELIEF])


SEGMENTS = np.array(
    [
        [[60, 200], [260, 205]],
        [[100, 230], [140, 80]],
        [[150, 220], [155, 42]],  # clipped
        [[40, 120], [290, 130]],
    ],
    float,
)


def measured(p, sensor):
    segments = Segments(p[6:].reshape(-1, 2, 2), jnp.ones((len(p) - 6) // 4, bool))
    found = measure(sensor, make_camera(), mount_of(p[:6]), segments, 8.0)
    return found.line, found.covariance, found.by_jitter, found.endpoints_nadir


def measured_by_default(p):
    return measured(p, SensorModel())


def measured_by_the_paper(p):
    return measured(p, SensorModel(propagate=False))


def test_gradients_of_measurements_and_their_covariances():
    assert_right(measured_by_default, [*MOUNT, *SEGMENTS.ravel()], rtol=1e-4)


@pytest.mark.parametrize("f", [measured_by_default, measured_by_the_paper])
def test_gradients_of_degenerate_measurements_are_finite(f):
    row = horizon_row(np.zeros(3))
    ends = [
        [[150, 150], [150, 150]],  # no length
        [[0, 0], [0, 0]],  # padding
        [[10, 5], [300, 9]],  # above the horizon
        [[150, row], [150, row]],  # at the horizon
        [[150, row], [150, 200]],
        [[100, 150], [240, 160]],
        [[100, 150], [240, 160]],  # the same again
        [[1e5, 1e5], [2e5, 1e5]],
    ]
    for four in (ends[:4], ends[4:]):
        assert_finite(f, [*MOUNT, *np.ravel(np.array(four, float))])


def likelihood(p, sensor):
    """log L and jitter by pose, mount and map; the last numbers of p are the problem's."""
    tilt_sigma, shift, valid, used = p[12:]
    sensor = eqx.tree_at(lambda s: s.tilt_sigma, sensor, tilt_sigma)
    segments = Segments(jnp.asarray(SEGMENTS), jnp.ones(4, bool))
    true = measure(sensor, make_camera(), mount_of(MOUNT), segments, 8.0).line
    measurements = measure(sensor, make_camera(), mount_of(p[3:9]), segments, 8.0)
    offsets = shift * np.random.default_rng(1).normal(size=(4, 2, 2)) + jnp.array(
        [[0, 0], [3, 0.5]]
    )
    line = PolarLine(
        true.rho[:, None] + offsets[..., 0] + p[9], true.theta[:, None] + offsets[..., 1] + p[10]
    )
    W = jnp.broadcast_to(jnp.array([[900.0, 100.0], [100.0, 2500.0]]), (4, 2, 2, 2))
    candidates = Candidates(
        line, jnp.ones((4, 2)) + p[11], W, W, jnp.broadcast_to(valid > 0.5, (4, 2))
    )
    used = jnp.broadcast_to(used > 0.5, 4)
    found = score(sensor, precompute(measurements, candidates), pose_of(p[:3]), used)
    return found.log_likelihood, found.jitter


def likelihood_by_default(p):
    return likelihood(p, SensorModel())


def likelihood_by_the_paper(p):
    return likelihood(p, SensorModel(propagate=False))


AT = [0.01, -0.02, 0.015, *MOUNT, 0.01, 0.005, 0.03]


@pytest.mark.parametrize("tilt_sigma", [0.0, 0.002])
@pytest.mark.parametrize("f", [likelihood_by_default, likelihood_by_the_paper])
def test_gradients_of_the_likelihood(f, tilt_sigma):
    value, *_ = differentiate(f, [*AT, tilt_sigma, 0.02, 1, 1])
    assert value[0] > -0.9 * 4 * 9 / 2  # most are matched
    assert_right(f, [*AT, tilt_sigma, 0.02, 1, 1], rtol=1e-4)


def test_the_likelihood_of_a_perfect_match_is_flat():
    """Identical lines: a maximum, not a place without a gradient."""
    at = [0, 0, 0, *MOUNT, 0, 0, 0, 0.002, 0.0, 1, 1]
    value, _, modes = differentiate(likelihood_by_default, at)
    assert value[0] == pytest.approx(0, abs=1e-9)
    for found in modes:
        np.testing.assert_allclose(found[0], 0, atol=1e-6)
        assert np.isfinite(found).all()


@pytest.mark.parametrize("masks", [(0, 1), (1, 0)], ids=["no candidate", "none used"])
def test_what_is_masked_has_no_gradient(masks):
    _, _, modes = differentiate(likelihood_by_default, [*AT, 0.002, 0.02, *masks])
    for found in modes:
        np.testing.assert_array_equal(found, 0)


def test_gradients_with_some_segments_masked_are_those_of_the_others():
    segments = Segments(jnp.asarray(SEGMENTS), jnp.ones(4, bool))
    sensor = SensorModel(tilt_sigma=0.002)
    found = jit_quickly(measure)(sensor, make_camera(), mount_of(MOUNT), segments, 8.0)
    W = 900 * jnp.broadcast_to(jnp.eye(2), (4, 1, 2, 2))
    line = PolarLine(found.line.rho[:, None] + 0.01, found.line.theta[:, None] - 0.005)
    lines = Candidates(line, jnp.ones((4, 1)), W, W, jnp.ones((4, 1), bool))
    keep = np.array([0, 2])

    @jit_quickly
    @jax.grad
    def gradient(p, measurements, lines, used):
        return score(sensor, precompute(measurements, lines), pose_of(p), used).log_likelihood

    mask = jnp.isin(jnp.arange(4), keep)
    fewer = jax.tree.map(lambda a: a[keep], (found, lines))
    at = jnp.array([0.004, -0.01, 0.003])
    expected = gradient(at, *fewer, jnp.ones(2, bool))
    np.testing.assert_allclose(gradient(at, found, lines, mask), expected)
    invalid = dataclasses.replace(found, valid=mask)
    np.testing.assert_allclose(gradient(at, invalid, lines, jnp.ones(4, bool)), expected)
    assert np.abs(expected).min() > 0


def test_padding_of_any_finite_precision_does_not_spread():
    """Candidates that are none may come with any finite precision, however large."""
    found = Measurements(
        jnp.zeros((2, 2, 2)),
        jnp.array([True, False]),
        PolarLine(jnp.array([1.0, 0.0]), jnp.array([0.1, 0.0])),
        jnp.zeros((2, 2, 2)),
        jnp.ones((2, 2, 2)),
    )
    W = jnp.stack([jnp.eye(2) * 100, jnp.eye(2) * 1e300])[:, None]
    lines = Candidates(
        PolarLine(jnp.array([[1.01], [0.0]]), jnp.array([[0.1], [0.0]])),
        jnp.ones((2, 1)),
        W,
        W,
        jnp.array([[True], [False]]),
    )

    def f(p):
        found_here = score(SensorModel(), precompute(found, lines), pose_of(p), jnp.ones(2, bool))
        return found_here.log_likelihood, found_here.jitter

    assert_finite(f, [0.1, 0.2, 0.1])


def test_gradients_of_how_a_map_line_appears():
    assert_right(
        lambda p: predict_measurement(p[:3], pose_of(p[3:6]), pose_of(p[6:9]))[0],
        [1.0, 0.3, 1.2, *POSE, 0.5, 0.2, -0.4],
    )
    assert_right(
        lambda p: posterior_given_class(MapConfig(), p[:3], jnp.diag(p[3:6]) + p[6])[0],
        [1.0, 0.3, 1.01, 0.1, 0.2, 0.3, 0.01],
    )
