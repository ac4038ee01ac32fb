"""The heights of the map's lines, by all views of them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from test_segment_map import (
    GAMMA,
    KALMAN,
    STIFF,
    M,
    across,
    assert_bitwise_equal,
    doubled,
    ends_of,
    grow,
    measurements_of,
    of_image,
    offset,
    pose,
    seen,
)

from sofjax.geometry.lines import polar_through
from sofjax.segment_map import (
    empty_map,
    is_off_floor,
    posterior_given_class,
    predict_measurement,
)

pytestmark = pytest.mark.usefixtures("x64")


def test_an_off_floor_line_does_not_join_the_floor_line_below_it():
    m, ends = doubled(KALMAN)
    off_floor = dataclasses.replace(
        m,
        line=m.line.at[0, 2].set(1.2),
        covariance=m.covariance.at[0, 2].set(0).at[0, :, 2].set(0).at[0, 2, 2].set(1e-4),
    )
    assert seen(off_floor, ends, slots=[1], rules=KALMAN).valid.sum() == 2


def off_floor_view(T, y, z, x0=0.0, x1=3.0, h=0.6):
    """Ends on the floor of a line at height z as they appear from a nadir."""
    apparent_scale = h / (h - z)
    return apparent_scale * np.asarray(T.inverse().apply(jnp.array(across(y, x0, x1))))


PATH = [(0.1 * i, 0.08 * i, 0.05 * i) for i in range(9)]


def drive_past(z, rules=KALMAN, sigma=0.005):
    """A line 1 m to the left, seen ever nearer."""
    m = empty_map(rules)
    for i, T in enumerate(pose(*where) for where in PATH):
        ends = off_floor_view(T, 1.0, z)
        m = seen(m, ends, at=T, slots=[0] if i else None, rules=rules, sigma=sigma)
    return m


@pytest.mark.parametrize("z", [0.0, 0.1, -0.4])
def test_the_height_of_a_line_is_found_from_all_its_views(z):
    m = drive_past(z)
    apparent_scale = 0.6 / (0.6 - z)
    sigma = float(np.sqrt(m.covariance[0, 2, 2]))
    assert abs(m.line[0, 2] - apparent_scale) < 1e-3
    assert sigma < 0.05
    assert bool(is_off_floor(KALMAN, m.line[0], m.covariance[0])) == (z != 0)
    # and the segment lies where the line is, not where it appears from anywhere
    np.testing.assert_allclose(ends_of(m)[:, 1], 1.0, atol=2e-3)


def test_an_off_floor_line_grows_to_where_it_ends_and_not_to_where_it_appears_to():
    m, T = drive_past(0.1), pose(*PATH[-1])
    apparent = off_floor_view(T, 1.0, 0.1, 1.0, 4.2)
    m = seen(m, apparent, at=T, slots=[0], rules=KALMAN, sigma=0.005)
    assert T.apply(jnp.asarray(apparent))[1, 0] > 4.8
    assert ends_of(m)[:, 0].max() == pytest.approx(4.2, abs=0.01)


@pytest.mark.parametrize(
    ("apparent_scale", "sigma", "expected"),
    [
        (1.2, 0.05, True),
        (1.2, 0.07, False),  # less than three sigmas from 1
        (1.03, 1e-4, False),  # as good as on the floor
        (0.8, 1e-4, False),  # nothing lies just under a floor
        (0.5, 0.1, True),  # a reflection lies deep
        (1.0, 1e-9, False),
    ],
)
def test_a_line_is_off_floor_if_all_its_views_say_so(apparent_scale, sigma, expected):
    line, covariance = (
        jnp.array([1.0, 0.0, apparent_scale]),
        jnp.diag(jnp.array([1.0, 1.0, sigma**2])),
    )
    assert bool(is_off_floor(KALMAN, line, covariance)) == expected
    assert not is_off_floor(GAMMA, line, covariance)  # the paper knows no heights


def test_a_line_taken_for_floor_is_conditioned_on_its_height(rng):
    """As the regression of (rho, theta) on the apparent scale says, of many draws."""
    root = np.array([[0.1, 0, 0], [0.02, 0.05, 0], [0.03, -0.01, 0.04]])
    line, covariance = np.array([1.0, 0.2, 1.02]), root @ root.T
    found, left = posterior_given_class(KALMAN, jnp.asarray(line), jnp.asarray(covariance))
    x = rng.multivariate_normal(line, covariance, size=200_000)
    A = np.column_stack([x[:, 2] - 1, np.ones(len(x))])
    fit, *_ = np.linalg.lstsq(A, x[:, :2])
    np.testing.assert_allclose(found, [*fit[1], 1], atol=1e-3)
    residual = np.cov((x[:, :2] - A @ fit).T)
    np.testing.assert_allclose(left[:2, :2], residual, rtol=0.03, atol=1e-5)
    np.testing.assert_allclose(left[2], 0, atol=1e-12)


def test_an_off_floor_line_is_taken_as_it_is():
    line, covariance = jnp.array([1.0, 0.2, 1.3]), jnp.diag(jnp.array([0.1, 0.1, 1e-4]))
    assert_bitwise_equal(posterior_given_class(KALMAN, line, covariance), (line, covariance))


@pytest.mark.parametrize("z", [0.0, 0.15, -0.3])
def test_a_line_appears_from_elsewhere_as_the_camera_will_see_it(camera, mounts, z, rng):
    """Ends at a height, projected by a tilted camera with a lever arm and put on the floor."""
    checked = 0
    for mount in mounts:
        if float(mount.height) < z + 0.05:
            continue
        first, second = rng.normal(size=(2, 3)) * [0.3, 0.3, 0.3]
        true = np.column_stack([rng.normal(size=(2, 2)) * 3, [z, z]])
        views = []
        for where in (first, second):
            pixels, _ = reference.project(camera.K, mount, where, true)
            H_F = reference.floor_homography(camera.K, mount, where)
            X = np.column_stack([pixels, np.ones(2)]) @ np.linalg.inv(H_F).T
            nadir = pose(*where) @ mount.T_robot_nadir
            ends = nadir.inverse().apply(jnp.asarray(X[:, :2] / X[:, 2:]))
            views.append((nadir, polar_through(ends)))
        (anchor, line), (there, expected) = views
        apparent_scale = float(mount.height) / (float(mount.height) - z)
        found, H = predict_measurement(
            jnp.array([line.rho, line.theta, apparent_scale]), anchor, there
        )
        d = reference.polar_difference((found[0], found[1]), (expected.rho, expected.theta))
        np.testing.assert_allclose(d, 0, atol=1e-7)
        by_difference = jax.jacfwd(lambda a, b, c: predict_measurement(a, b, c)[0][:2])(
            jnp.array([line.rho, line.theta, apparent_scale]), anchor, there
        )
        np.testing.assert_allclose(H, by_difference, atol=1e-9)
        checked += 1
    assert checked > 3


def test_the_kalman_rule_is_a_plain_extended_kalman_filter(rng):
    rules = dataclasses.replace(KALMAN, rho_drift=0.003, theta_drift=0.002)
    m, x, P = empty_map(rules), None, None
    R = np.diag([0.005**2 + 0.003**2, 0.005**2 + 0.002**2])
    for i, T in enumerate(pose(*where) for where in PATH):
        ends = off_floor_view(T, 1.0, 0.05) + 0.003 * rng.normal(size=(2, 2))
        rho, theta = reference.polar_through(*ends)
        m = seen(m, ends, at=T, slots=[0] if i else None, rules=rules, sigma=0.005)
        if i == 0:
            x, P = np.array([rho, theta, 1.0]), np.diag([0.005**2, 0.005**2, 0.3**2])
            continue
        t = np.asarray(T.xy)  # the anchor is the origin
        n, d = np.array([-np.sin(x[1]), np.cos(x[1])]), np.array([np.cos(x[1]), np.sin(x[1])])
        expected = (x[0] - x[2] * n @ t, x[1] - float(T.yaw))
        H = np.array([[1, x[2] * d @ t, -n @ t], [0, 1, 0]])
        gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x = x + gain @ reference.polar_difference((rho, theta), expected)
        P = P - gain @ H @ P
        np.testing.assert_allclose(m.line[0], x, rtol=1e-9)
        np.testing.assert_allclose(m.covariance[0], P, rtol=1e-6, atol=1e-12)


def test_two_pieces_of_one_line_inform_as_two_measurements_would():
    m = seen(empty_map(KALMAN), across(1.0, 0, 4), rules=KALMAN)
    pieces = across(1.01, 0, 1), across(0.98, 3, 4)
    together = seen(m, *pieces, slots=[0, 0], rules=KALMAN)
    one_by_one = m
    for piece in pieces:
        one_by_one = seen(one_by_one, piece, slots=[0], rules=KALMAN)
    np.testing.assert_allclose(together.line[0], one_by_one.line[0], rtol=1e-9)
    np.testing.assert_allclose(together.covariance[0], one_by_one.covariance[0], rtol=1e-6)


def test_a_jitter_is_taken_out_of_what_is_integrated():
    measurements = dataclasses.replace(
        measurements_of(across(1.03)),
        by_jitter=jnp.broadcast_to(jnp.array([[3.0, 0.0], [0.0, 0.0]]), (M, 2, 2)),
    )
    m = seen(empty_map(GAMMA), across(1.0))
    known = jnp.arange(M) < 1
    after, *_ = grow(
        GAMMA, STIFF, m,
        of_image(measurements, known, ~known & measurements.valid, jitter=(0.01, 0.0)),
    )  # fmt: skip
    assert offset(after) == pytest.approx(1.0)
