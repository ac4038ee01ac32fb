"""Measurements: the segments of an image on the floor, with their errors; II.B, III.A."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from conftest import jit_quickly

from sofjax.geometry import Mount, PolarLine, Segments
from sofjax.likelihood.measurements import (
    Measurements,
    SensorModel,
    measure,
    unobservable_direction,
)

pytestmark = pytest.mark.usefixtures("x64")

see = jit_quickly(measure)
DEPTH = 8.0
SEGMENTS = np.array(
    [
        [[60, 200], [260, 205]],  # across, near
        [[40, 90], [290, 96]],  # across, far
        [[100, 230], [140, 80]],  # along
        [[150, 220], [155, 62]],  # along, to beyond the greatest depth
        [[300, 150], [310, 200]],
    ],
    float,
)


def segments(ends, valid=True):
    """Padded to as many as there are in SEGMENTS: one shape, one compilation."""
    padded = np.zeros(SEGMENTS.shape)
    padded[: len(ends)] = ends
    return Segments(jnp.asarray(padded), (jnp.arange(len(padded)) < len(ends)) & valid)


@pytest.fixture
def rolled():
    return Mount.create(height=0.6, pitch=0.26, x=0.1, y=-0.05, roll=0.05, yaw=0.1)


def floor_lines(camera, mount, ends):
    """(rho, theta) about the nadir of many segments [..., 2, 2] in plain numpy."""
    inverse = np.linalg.inv(reference.floor_homography(camera.K, mount, (0, 0, 0)))
    X = np.concatenate([ends, np.ones((*ends.shape[:-1], 1))], axis=-1) @ inverse.T
    points = X[..., :2] / X[..., 2:] - [float(mount.x), float(mount.y)]
    d = points[..., 1, :] - points[..., 0, :]
    theta = np.arctan2(d[..., 1], d[..., 0])
    return np.stack(
        [-np.sin(theta) * points[..., 0, 0] + np.cos(theta) * points[..., 0, 1], theta], -1
    )


def test_a_measurement_worked_by_hand(camera):
    # level, 1 m up: a row 54 px below the centre is 5 m away, and a pixel there 5² / 270 m
    level = Mount.create(height=1.0, x=0.2)
    across = segments([[[100.0, 173.5], [200.0, 173.5]]])
    found = see(SensorModel(pixel_sigma=0.5), camera, level, across, DEPTH)
    np.testing.assert_allclose(found.endpoints_nadir[0], [[5, 59.5 / 54], [5, -40.5 / 54]])
    assert abs(found.line.rho[0]) == pytest.approx(5)  # about the nadir, not the axle
    assert abs(found.line.theta[0]) == pytest.approx(np.pi / 2)
    # rho is at y = 0, between the ends: their noises are weighted by 40.5 and 59.5 per cent
    assert found.covariance[0, 0, 0] == pytest.approx(
        (0.5 * 25 / 270) ** 2 * (0.405**2 + 0.595**2), rel=1e-6
    )
    assert found.covariance[0, 1, 1] == pytest.approx(2 * (0.5 * 25 / 270 / (100 / 54)) ** 2)


def test_the_covariance_is_that_of_many_noisy_pixels(camera, rolled, rng):
    sensor = SensorModel(pixel_sigma=0.05)
    found = see(sensor, camera, rolled, segments(SEGMENTS), DEPTH)
    assert found.valid.all()
    noisy = SEGMENTS + rng.normal(0, 0.05, size=(20_000, *SEGMENTS.shape))
    lines = floor_lines(camera, rolled, noisy)
    np.testing.assert_allclose(
        np.stack([found.line.rho, found.line.theta], 1), lines.mean(0), atol=1e-3
    )
    for m in range(len(SEGMENTS)):
        covariance = np.cov(lines[:, m].T)
        scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
        np.testing.assert_allclose(found.covariance[m] / scale, covariance / scale, atol=0.05)


def test_a_far_segment_is_known_less_well(camera, mount):
    rows = (220.0, 160.0, 120.0, 90.0)
    across = segments([[[100, row], [220, row]] for row in rows])
    found = see(SensorModel(), camera, mount, across, DEPTH)
    sigma = np.sqrt(np.asarray(found.covariance[: len(rows), 0, 0]))
    assert (np.diff(sigma) > 0).all()


def test_noise_multiplies_the_variance_of_the_pixels(camera, mount):
    once, thrice = (
        see(SensorModel(), camera, mount, segments(SEGMENTS), DEPTH, noise) for noise in (1.0, 3.0)
    )
    np.testing.assert_allclose(thrice.covariance, 3 * once.covariance)
    np.testing.assert_array_equal(thrice.by_jitter, once.by_jitter)


def test_a_known_jitter_is_corrected(camera, rolled):
    """An image taken with the camera tipped by the jitter, put on the floor as if it were not."""
    jitter = np.array([0.002, -0.003])
    tipped = Mount.create(
        height=0.6, pitch=0.26 + jitter[0], x=0.1, y=-0.05, roll=0.05 + jitter[1], yaw=0.1
    )
    found = see(SensorModel(), camera, rolled, segments(SEGMENTS), DEPTH)
    true = floor_lines(camera, tipped, SEGMENTS)
    corrected = found.without_jitter(jnp.asarray(jitter))
    before = np.stack([found.line.rho, found.line.theta], 1) - true
    after = np.stack([corrected.rho, corrected.theta], 1) - true
    assert (np.linalg.norm(after, axis=1) < 0.05 * np.linalg.norm(before, axis=1)).all()


def test_the_paper_has_one_constant_sigma(camera, mount):
    sensor = SensorModel(propagate=False, rho_sigma=0.05, theta_sigma=0.03)
    found = see(sensor, camera, mount, segments(SEGMENTS), DEPTH)
    np.testing.assert_allclose(
        found.covariance, np.broadcast_to(np.diag([0.05**2, 0.03**2]), (5, 2, 2))
    )
    np.testing.assert_array_equal(found.by_jitter, 0)


def test_a_segment_whose_direction_is_hardly_known_is_no_measurement(camera, mount):
    short = segments([[[150, 150], [152, 150]], [[50, 150], [250, 150]]])
    found = see(SensorModel(theta_limit=0.2), camera, mount, short, DEPTH)
    np.testing.assert_array_equal(found.valid[:2], [False, True])


@pytest.mark.parametrize("propagate", [True, False])
def test_what_has_no_length_or_lies_above_the_horizon_is_no_measurement(camera, mount, propagate):
    ends = [[[150, 150], [150, 150]], [[10, 5], [300, 9]], [[50, 150], [250, 150]]]
    found = see(SensorModel(propagate=propagate), camera, mount, segments(ends), DEPTH)
    np.testing.assert_array_equal(found.valid[:3], [False, False, True])
    for leaf in jax.tree.leaves(found):
        assert np.isfinite(leaf).all()


def test_padding_is_no_measurement_and_finite(camera, mount):
    for ends in (np.zeros((5, 2, 2)), SEGMENTS):
        found = see(SensorModel(), camera, mount, segments(ends, valid=False), DEPTH)
        assert not found.valid.any()
        for leaf in jax.tree.leaves(found):
            assert np.isfinite(leaf).all()


def along(*theta, sigma=0.01):
    theta = jnp.array(theta)
    line = PolarLine(jnp.ones_like(theta), theta)
    covariance = jnp.broadcast_to(jnp.diag(jnp.array([1e-4, sigma**2])), (len(theta), 2, 2))
    none = jnp.zeros_like(covariance)
    return Measurements(none, theta < 9, line, covariance, none)


def test_lines_that_all_run_one_way_leave_it_free():
    all_known = lambda s: unobservable_direction(s, s.valid)
    free, parallel = all_known(along(0.3, 0.32, 0.29, 0.3 + np.pi, 0.3 - np.pi))
    assert parallel and np.sin(free - 0.3) == pytest.approx(0, abs=0.01)
    assert not all_known(along(0.3, 0.3, 0.3, 0.5))[1]
    assert not all_known(along(0.3, 0.3, 0.3, 0.3 + np.pi / 2))[1]
    assert all_known(along(0.3, 0.3, 0.3, 0.5, sigma=0.1))[1]  # as far as can be seen
    assert all_known(along(np.pi / 2, -np.pi / 2))[1]


def test_what_is_not_known_tells_no_direction():
    measurements = along(0.3, 0.31, 1.5)
    assert unobservable_direction(measurements, jnp.array([True, True, False]))[1]
    assert not unobservable_direction(measurements, jnp.array([True, True, True]))[1]
    free, parallel = unobservable_direction(measurements, jnp.zeros(3, bool))
    assert not parallel and np.isfinite(free)
