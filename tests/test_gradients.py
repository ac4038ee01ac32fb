"""Gradients of everything up to the likelihood: right where they exist, finite everywhere.

Against central differences in float64, at ordinary points and at the degenerate ones.
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from conftest import jit_quickly, make_camera

from sofjax.extraction.association import Association, association_error
from sofjax.geometry import (
    SE2,
    Mount,
    PolarLine,
    Segments,
    floor_homography,
    floor_to_image,
    image_to_floor,
    line_through,
    overlap,
    polar,
    polar_difference,
    segment_to_floor,
    transfer_line,
    two_view_homography,
)
from sofjax.geometry.lines import line_point_distance, polar_in_frame, polar_through
from sofjax.geometry.segments import clip
from sofjax.geometry.two_view import transfer_segment
from sofjax.likelihood.measurements import Measurements, measure
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.likelihood.tracking import Candidates, precompute, score
from sofjax.motion import MotionModel, prior_bias, sample_motion, sample_slip
from sofjax.segment_map import MapConfig, posterior_given_class, predict_measurement

pytestmark = pytest.mark.usefixtures("x64")

MOUNT = np.array([0.05, -0.02, 0.6, 0.2618, 0.03, 0.1])  # in the order of the fields
POSE = np.array([0.3, -0.2, 0.15])
STEP = 1e-5  # of the differences


def mount_of(p):
    return Mount(*jnp.asarray(p))


def pose_of(p):
    return SE2(p[:2], p[2])


def numbers(tree):
    """All floats that a function gives, in one vector."""
    leaves = [jnp.ravel(a) for a in jax.tree.leaves(tree) if jnp.issubdtype(a.dtype, jnp.floating)]
    return jnp.concatenate(leaves)


@functools.cache
def derivatives(function):
    """The values about a point and both modes' Jacobians there, compiled quickly and once."""

    def f(x):
        return numbers(function(x))

    def everything(x, about):
        return jax.vmap(f)(about), f(x), jax.jacfwd(f)(x), jax.jacrev(f)(x)

    return jit_quickly(everything)


def differentiate(function, at):
    """Value, values about the point, and the Jacobians by forward and reverse mode."""
    at = np.asarray(at, float)
    n = len(at)
    steps = STEP * np.concatenate([np.eye(n), -np.eye(n), np.eye(n) / 2, -np.eye(n) / 2])
    about, value, *modes = derivatives(function)(jnp.asarray(at), jnp.asarray(at + steps))
    return np.asarray(value), np.asarray(about), [np.asarray(mode) for mode in modes]


def assert_right(function, at, rtol=1e-5):
    """Forward and reverse mode agree with central differences."""
    _, about, modes = differentiate(function, at)
    plus, minus, plus_half, minus_half = np.split(about, 4)
    # by two step sizes: their errors of the second order cancel
    expected = ((4 * (plus_half - minus_half) - (plus - minus) / 2) / (3 * STEP)).T
    scale = 1e-6 + np.abs(expected).max()
    for found in modes:
        np.testing.assert_allclose(found, expected, rtol=rtol, atol=rtol * scale)


def assert_finite(function, at):
    value, _, modes = differentiate(function, at)
    for found in (value, *modes):
        assert np.isfinite(found).all()


# The ground


def log(p):
    return pose_of(p).log()


@pytest.mark.parametrize("omega", [0.0, 1e-9, 5e-4, 0.999e-3, 1.001e-3, -0.7, 3.0])
def test_gradients_of_exp_and_log(omega):
    """Near zero by their series, which meets the closed form at 1e-3."""
    assert_right(SE2.exp, [0.4, -0.3, omega])
    assert_right(log, [0.4, -0.3, omega])


def test_gradients_of_composition_and_inverse():
    assert_right(lambda p: pose_of(p[:3]) @ pose_of(p[3:]).inverse(), [*POSE, 1.0, 0.4, -2.0])
    assert_right(lambda p: pose_of(p[:3]).between(pose_of(p[3:])), [*POSE, *POSE])


def H_F_of(p):
    return floor_homography(make_camera(), mount_of(p[:6]), pose_of(p[6:9]))


def pixel(p):
    return floor_to_image(H_F_of(p), p[9:])[0]


def floor_point(p):
    return image_to_floor(H_F_of(p), p[9:])[0]


def floor_segment(p):
    return segment_to_floor(H_F_of(p), p[9:].reshape(2, 2), jnp.asarray(8.0))[0]


def test_gradients_of_points_between_floor_and_image():
    assert_right(pixel, [*MOUNT, *POSE, 2.0, 0.5])
    assert_right(floor_point, [*MOUNT, *POSE, 150.0, 180.0])


def horizon_row(pose=POSE):
    """The row at column 150 in which 1 / depth is zero, as near as numbers go."""
    H_F = reference.floor_homography(make_camera().K, mount_of(MOUNT), pose)
    a, b, c = np.linalg.inv(H_F)[2]
    return -(a * 150 + c) / b


@pytest.mark.parametrize("above", [-1e-9, 0.0, 1e-9, 30.0])
def test_gradients_at_and_above_the_horizon_are_finite(above):
    point = [150.0, horizon_row() - above]
    assert_finite(floor_point, [*MOUNT, *POSE, *point])
    for segment in ([*point, *point], [*point, 150.0, 200.0], [20.0, 200.0, *point]):
        assert_finite(floor_segment, [*MOUNT, *POSE, *segment])


def test_gradients_behind_and_beside_the_camera_are_finite():
    for point in ((-3.0, 0.0), (0.0, 0.0), tuple(POSE[:2])):
        assert_finite(pixel, [*MOUNT, *POSE, *point])


@pytest.mark.parametrize(
    "segment",
    [
        [60.0, 200.0, 260.0, 150.0],  # whole
        [60.0, 200.0, 100.0, 30.0],  # clipped at the greatest depth
        [100.0, 30.0, 60.0, 200.0],
    ],
)
def test_gradients_of_a_segment_on_the_floor(segment):
    """Where it is clipped, the end moves along the greatest depth."""
    assert_right(floor_segment, [*MOUNT, *POSE, *segment])


def two_views(p):
    return two_view_homography(make_camera(), mount_of(p[:6]), pose_of(p[6:9]))


def test_gradients_of_the_two_view_homography():
    assert_right(two_views, [*MOUNT, *POSE])
    assert_right(two_views, [*MOUNT, 0.0, 0.0, 0.0])


def test_gradients_of_a_transferred_segment_and_line():
    def transfer(p):
        H = two_views(jnp.concatenate([jnp.asarray(MOUNT), p[:3]]))
        line = polar(transfer_line(H, line_through(p[3:5], p[5:7])))
        return transfer_segment(H, p[3:7].reshape(2, 2))[0], line

    assert_right(transfer, [*POSE, 60.0, 200.0, 260.0, 150.0])
    # partly and wholly behind the second camera, and without length
    for x, segment in ((2.0, [160, 235, 160, 80]), (9.0, [60, 200, 260, 210]), (0.3, [9, 9, 9, 9])):
        assert_finite(transfer, [x, 0.0, 0.0, *segment])


# Lines


def by_ends(p):
    ends = p.reshape(2, 2)
    line, other = polar_through(ends), polar(line_through(*ends))
    return line, other, polar_in_frame(line, pose_of(jnp.array([0.2, -0.3, 0.5])))


@pytest.mark.parametrize(
    "ends",
    [
        [0.3, 0.2, 1.0, -0.7],
        [-1.0, -1.0, 2.0, 2.0],  # rho = 0
        [0.0, 1.0, 2.0, 1.0],  # theta = 0
        [2.0, 1.0, 0.0, 1.1],  # theta near pi
        [1.0, 0.0, 1.0, 2.0],  # theta = pi / 2
        [0.0, 0.0, 1.0, 2.0],  # from the origin
    ],
)
def test_gradients_of_polar_lines(ends):
    assert_right(by_ends, ends)


def lengths(p):
    ends, other = p[:4].reshape(2, 2), p[4:].reshape(2, 2)
    return (
        overlap(ends, other),
        overlap(other, ends),
        Segments(ends, jnp.array(True)).length,
        line_point_distance(line_through(*ends), other[0]),
        clip(ends, other[1])[0],
    )


def test_gradients_of_lengths_distances_and_clipping():
    assert_right(lengths, [0.3, 0.2, 1.0, -0.7, 0.1, -0.5, 0.9, -0.8])
    assert_right(lengths, [0.3, 0.2, 1.0, -0.7, 0.1, -0.5, -0.9, 0.8])
    assert_right(lengths, [0.3, 0.2, 1.0, -0.7, 0.1, -0.5, 0.9, 0.8])


@pytest.mark.parametrize("ends", [[0.0] * 4, [1.0, 2.0, 1.0, 2.0]])
def test_gradients_of_a_segment_without_length_are_finite(ends):
    assert_finite(by_ends, ends)
    for other in ([0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0]):
        assert_finite(lengths, [*ends, *other])


def difference(p):
    return polar_difference(PolarLine(p[0], p[1]), PolarLine(p[2], p[3]))


@pytest.mark.parametrize(
    "lines",
    [
        [1.0, 0.2, 0.7, 0.1],
        [1.0, 0.2, 1.0, 0.2],  # the same
        [1.0, 0.2, -1.0, 0.2 + np.pi],  # the same by its other name
        [0.0, 0.2, 0.0, 0.2 - np.pi],  # and through the origin
        [1.0, 0.2, 0.5, 0.2],  # parallel
        [1.0, np.pi - 1e-9, 1.0, -np.pi + 1e-9],
    ],
)
def test_gradients_of_a_difference_of_lines(lines):
    assert_right(difference, lines)


# Association


def association(p):
    first, second = p[9:13].reshape(2, 2), p[13:17].reshape(2, 2)
    return association_error(Association(), make_camera(), two_views(p[:9]), first, second)


def test_gradients_of_the_association_error():
    first, second = [100, 150, 240, 160], [80, 180, 250, 190]
    assert_right(association, [*MOUNT, 0.2, 0.01, 0.05, *first, *second])


def test_gradients_of_the_association_error_are_finite_where_it_has_a_kink():
    still, same = [0.0, 0.0, 0.0], [100, 150, 240, 160]
    assert_finite(association, [*MOUNT, *still, *same, *same])


@pytest.mark.parametrize(
    ("motion", "first", "second"),
    [
        ([0.2, 0, 0], [100, 150, 240, 160], [0, 20, 9, 30]),  # no overlap
        ([9.0, 0, 0], [100, 150, 240, 160], [100, 150, 240, 160]),  # driven past
        ([0.2, 0, 0], [100, 150, 100, 150], [100, 150, 240, 160]),  # no length
        ([0.2, 0, 0], [100, 150, 240, 160], [100, 150, 100, 150]),
    ],
)
def test_an_association_that_is_none_has_no_gradient(motion, first, second):
    value, _, modes = differentiate(association, [*MOUNT, *motion, *first, *second])
    assert value == np.inf
    for found in modes:
        np.testing.assert_array_equal(found, 0)


# Motion


def drawn(p):
    model = eqx.tree_at(lambda m: (m.distance_noise, m.turn_noise), MotionModel(), (p[3], p[4]))
    bias = dataclasses.replace(prior_bias(MotionModel()), mean=p[5:9])
    motion, learned = sample_motion(model, bias, SE2.exp(p[:3]), jax.random.key(0))
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


# Sensor model

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


# The map's view of a line


def test_gradients_of_how_a_map_line_appears():
    assert_right(
        lambda p: predict_measurement(p[:3], pose_of(p[3:6]), pose_of(p[6:9]))[0],
        [1.0, 0.3, 1.2, *POSE, 0.5, 0.2, -0.4],
    )
    assert_right(
        lambda p: posterior_given_class(MapConfig(), p[:3], jnp.diag(p[3:6]) + p[6])[0],
        [1.0, 0.3, 1.01, 0.1, 0.2, 0.3, 0.01],
    )
