"""Lines: homogeneous and polar form, transfer, and differences whatever the lines are named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from sofjax.geometry import SE2, PolarLine, line_through, polar, polar_difference, transfer_line
from sofjax.geometry.lines import (
    alignment,
    cofactor,
    direction,
    line_point_distance,
    normal,
    polar_in_frame,
    polar_through,
    rename_covariance,
)

pytestmark = pytest.mark.usefixtures("x64")


def line(rho, theta):
    return PolarLine(jnp.array(rho, float), jnp.array(theta, float))


def difference(a, b):
    return np.asarray(polar_difference(line(*a), line(*b)))


def same_line(a, b):
    np.testing.assert_allclose(polar_difference(a, b), 0, atol=1e-9)


@pytest.mark.parametrize(
    ("x1", "x2", "rho", "theta"),
    [
        ((0, 1), (1, 1), 1, 0),  # ahead along the first axis, on its left
        ((1, 1), (0, 1), -1, np.pi),  # the same from its other end
        ((2, 0), (2, 3), -2, np.pi / 2),
        ((1, 0), (0, 1), -np.sqrt(0.5), 3 * np.pi / 4),
        ((0, 0), (1, 1), 0, np.pi / 4),
    ],
)
def test_a_polar_line_worked_by_hand(x1, x2, rho, theta):
    ends = jnp.array([x1, x2], float)
    for found in (polar(line_through(*ends)), polar_through(ends)):
        np.testing.assert_allclose(found.rho, rho, atol=1e-12)
        np.testing.assert_allclose(normal(found), [-np.sin(theta), np.cos(theta)], atol=1e-12)


def test_a_difference_worked_by_hand():
    np.testing.assert_allclose(difference((1.0, 0.2), (0.7, 0.1)), [0.3, 0.1])
    # the second named from its other side
    np.testing.assert_allclose(difference((1.0, 0.2), (-0.7, 0.1 + np.pi)), [0.3, 0.1], atol=1e-12)


def test_polar_through_is_polar_of_the_homogeneous_line(rng):
    for ends in jnp.asarray(rng.normal(size=(30, 2, 2))):
        a, b = polar_through(ends), polar(line_through(*ends))
        np.testing.assert_allclose([a.rho, a.theta], [b.rho, b.theta], atol=1e-9)
        np.testing.assert_allclose([a.rho, a.theta], reference.polar_through(*ends), atol=1e-12)


def test_every_point_of_a_polar_line_has_n_x_equal_to_rho(rng):
    for ends in jnp.asarray(rng.normal(size=(10, 2, 2))):
        found = polar_through(ends)
        points = ends[0] + jnp.asarray(rng.normal(size=(5, 1))) * (ends[1] - ends[0])
        np.testing.assert_allclose(points @ normal(found), found.rho, atol=1e-12)
        np.testing.assert_allclose(normal(found) @ direction(found), 0, atol=1e-12)


def test_the_scale_of_a_homogeneous_line_does_not_matter(rng):
    l = jnp.asarray(rng.normal(size=3))
    same_line(polar(l), polar(7 * l))
    same_line(polar(l), polar(-7 * l))


def test_points_that_coincide_have_no_line_and_it_is_zero():
    ends = jnp.array([[1.0, 2.0], [1.0, 2.0]])
    np.testing.assert_array_equal(line_through(*ends), 0)
    for found in (
        polar(line_through(*ends)),
        polar_through(ends),
        polar(jnp.array([0.0, 0.0, 1.0])),
    ):
        assert (found.rho, found.theta) == (0, 0)


def test_transferred_line_passes_through_transferred_points(rng):
    for _ in range(10):
        H = jnp.asarray(rng.normal(size=(3, 3)))
        ends = jnp.asarray(rng.normal(size=(2, 2)))
        moved = transfer_line(H, line_through(*ends))
        for point in ends:
            x = H @ jnp.append(point, 1.0)
            assert abs(moved @ x) < 1e-10 * jnp.linalg.norm(moved) * jnp.linalg.norm(x)


def test_a_line_is_transferred_by_the_inverse_transpose(rng):
    for _ in range(10):
        H, l = jnp.asarray(rng.normal(size=(3, 3))), jnp.asarray(rng.normal(size=3))
        expected = np.linalg.det(H) * np.linalg.inv(H).T @ l
        np.testing.assert_allclose(transfer_line(H, l), expected, rtol=1e-9)
        np.testing.assert_allclose(cofactor(H).T @ H, np.linalg.det(H) * np.eye(3), atol=1e-9)


def test_transfer_there_and_back_is_the_same_line(rng):
    H, l = jnp.asarray(rng.normal(size=(3, 3))), jnp.asarray(rng.normal(size=3))
    same_line(polar(transfer_line(jnp.linalg.inv(H), transfer_line(H, l))), polar(l))


def test_a_singular_homography_still_has_a_finite_transfer():
    assert jnp.isfinite(transfer_line(jnp.diag(jnp.array([1.0, 1.0, 0.0])), jnp.ones(3))).all()


LINES = [(0.8, 0.3), (-0.8, 0.3), (0.0, 0.3), (1.5, -1.5), (1e-9, 3.0), (2.0, 1.56)]


@pytest.mark.parametrize("first", LINES)
@pytest.mark.parametrize("second", LINES)
@pytest.mark.parametrize("half_turns", [-3, -1, 1, 2])
def test_a_difference_does_not_depend_on_the_side_a_line_is_named_from(first, second, half_turns):
    renamed = ((-1) ** half_turns * second[0], second[1] + half_turns * np.pi)
    expected = difference(first, second)
    np.testing.assert_allclose(difference(first, renamed), expected, atol=1e-12)
    # naming the first from its other side turns the axis along which rho is counted
    first = ((-1) ** half_turns * first[0], first[1] + half_turns * np.pi)
    expected = expected * [(-1) ** half_turns, 1]
    np.testing.assert_allclose(difference(first, second), expected, atol=1e-12)


@pytest.mark.parametrize("theta", [0.0, np.pi / 2, np.pi, -np.pi, 3.1])
@pytest.mark.parametrize("rho", [0.0, 1e-6, -1e-6, 2.0])
def test_nearly_the_same_line_differs_by_little_across_every_jump(theta, rho):
    """At the jump of theta, and at rho = 0, where the sign of rho does."""
    for name in ((rho + 1e-3, theta + 2e-3), (-rho - 1e-3, theta + 2e-3 - np.pi)):
        d = difference(name, (rho, theta))
        np.testing.assert_allclose(np.abs(d), [1e-3, 2e-3], atol=1e-12)


def test_a_difference_is_the_smallest_of_all_names(rng):
    for a, b in rng.normal(size=(200, 2, 2)) * [2, 3]:
        expected = reference.polar_difference(a, b)
        if abs(expected[1]) < np.pi / 2 - 1e-6:
            np.testing.assert_allclose(difference(a, b), expected, atol=1e-12)


def test_a_line_differs_from_itself_by_nothing(rng):
    for a in rng.normal(size=(20, 2)) * 3:
        np.testing.assert_allclose(difference(a, a), 0, atol=1e-12)


def test_the_covariance_of_the_other_name_is_that_of_its_numbers(rng):
    lines = rng.multivariate_normal([0, 0], [[4, 1], [1, 2]], size=100)
    named = lines * [-1, 1] + [0, np.pi]
    for other, side in ((lines, 1.0), (named, -1.0)):
        found = rename_covariance(jnp.asarray(np.cov(lines.T)), jnp.array(side))
        np.testing.assert_allclose(found, np.cov(other.T))
    for a, b in zip(lines, named, strict=True):
        assert alignment(line(*a), line(*b)) == -1
        assert alignment(line(*a), line(*a)) == alignment(line(*b), line(*b)) == 1


def test_perpendicular_lines_differ_by_a_right_angle():
    for theta in (-np.pi / 2, np.pi / 2, 3 * np.pi / 2):
        assert abs(difference((1.0, 0.0), (1.0, theta))[1]) == pytest.approx(np.pi / 2)


def test_a_line_in_another_frame_passes_through_its_points_there(rng):
    for _ in range(10):
        ends = jnp.asarray(rng.normal(size=(2, 2)))
        T_a_b = SE2(jnp.asarray(rng.normal(size=2)), jnp.asarray(rng.normal()))
        found = polar_in_frame(polar_through(ends), T_a_b)
        same_line(found, polar_through(T_a_b.inverse().apply(ends)))


def test_the_distance_of_a_point_worked_by_hand():
    l = line_through(jnp.array([0.0, 1.0]), jnp.array([5.0, 1.0]))
    assert line_point_distance(l, jnp.array([2.0, 4.0])) == pytest.approx(3)
    assert line_point_distance(l, jnp.array([9.0, -1.0])) == pytest.approx(-2)
    assert line_point_distance(jnp.zeros(3), jnp.array([9.0, -1.0])) == 0


def test_far_from_the_origin_float32_keeps_a_line_by_its_end_points():
    """x1 × x2 cancels there; the middle and the normal do not."""
    ends = np.array([[200.0, 100.0], [200.3, 100.4]])
    exact = reference.polar_through(*ends.astype("float32").astype(float))
    with jax.enable_x64(False):
        narrow = jnp.asarray(ends, "float32")
        by_ends, by_cross = polar_through(narrow), polar(line_through(*narrow))
    assert abs(by_ends.rho - exact[0]) < 1e-4 < abs(by_cross.rho - exact[0])
