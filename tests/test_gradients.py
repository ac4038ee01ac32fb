"""Gradients of everything up to the likelihood: right where they exist, finite everywhere.

Against central differences in float64, at ordinary points and at the degenerate ones.
"""

import functools

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


# Sensor model
