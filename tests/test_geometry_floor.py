"""Between the floor and one image of it; eqs. (6) and (10) to (13)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from conftest import jit_quickly

from sofjax.geometry import (
    SE2,
    Mount,
    floor_homography,
    floor_to_image,
    image_to_floor,
    line_through,
    line_to_floor,
    line_to_image,
    may_be_upright,
    projection_matrix,
    segment_to_floor,
)
from sofjax.geometry.floor import horizon

pytestmark = pytest.mark.usefixtures("x64")
DEPTH = 8.0
to_image = jit_quickly(jax.vmap(floor_to_image, (None, 0)))
from_image = jit_quickly(jax.vmap(image_to_floor, (None, 0)))


@jit_quickly
def segments_to_floor(H_F, segments, max_depth):
    return jax.vmap(segment_to_floor, (None, 0, None))(H_F, segments, jnp.asarray(max_depth, float))


def pose(x, y, yaw):
    return SE2(jnp.array([x, y], float), jnp.array(yaw, float))


def to_floor(H_F, segment, max_depth=DEPTH):
    found, some = segments_to_floor(H_F, jnp.asarray([segment], float), max_depth)
    return found[0], some[0]


@pytest.fixture
def level(camera):
    """H_F of a camera 1 m over the floor that looks straight ahead: Y = 270 / (y - 119.5) etc."""
    return floor_homography(camera, Mount.create(height=1.0), SE2.identity())


def test_the_floor_worked_by_hand(level):
    point, visible = image_to_floor(level, jnp.array([159.5 - 27, 119.5 + 54]))
    np.testing.assert_allclose(point, [5.0, 0.5])
    assert visible
    pixel, visible = floor_to_image(level, jnp.array([5.0, 0.5]))
    np.testing.assert_allclose(pixel, [159.5 - 27, 119.5 + 54])
    assert visible


def test_a_segment_across_the_horizon_worked_by_hand(level):
    # straight up the middle of the image: from 2 m ahead to beyond the horizon
    segment, some = to_floor(level, [[159.5, 119.5 + 135], [159.5, 50.0]])
    np.testing.assert_allclose(segment, [[2, 0], [DEPTH, 0]], atol=1e-9)
    assert some


def test_H_F_is_P_without_its_third_column(camera, mount):
    P = projection_matrix(camera, mount, pose(1, 2, 0.5))
    np.testing.assert_array_equal(floor_homography(camera, mount, pose(1, 2, 0.5)), P[:, [0, 1, 3]])


def test_H_F_of_a_pose_is_that_of_the_robot_frame_after_its_inverse(camera, mounts):
    for mount in mounts:
        inverse = reference.pose_matrix([1, 2, 0.5])
        np.testing.assert_allclose(
            floor_homography(camera, mount, pose(1, 2, 0.5)) @ inverse,
            floor_homography(camera, mount, SE2.identity()),
            atol=1e-9,
        )


def test_floor_to_image_and_back_is_the_same_point(camera, mounts, rng):
    for mount in mounts:
        H_F = floor_homography(camera, mount, pose(*rng.normal(size=3)))
        points = jnp.asarray(rng.normal(size=(50, 2)) * 4)
        pixels, ahead = to_image(H_F, points)
        back, visible = from_image(H_F, pixels)
        assert ahead.any() and not ahead.all()
        assert visible[ahead].all()
        np.testing.assert_allclose(back[ahead], points[ahead], atol=1e-8)


def test_a_pixel_sees_the_floor_where_its_ray_points_down_and_nowhere_else(camera, mounts, rng):
    seen = []
    for mount in mounts:
        where = rng.normal(size=3)
        H_F = floor_homography(camera, mount, pose(*where))
        pixels = rng.uniform(0, 320, size=(60, 2))
        points, visible = from_image(H_F, jnp.asarray(pixels))
        assert np.isfinite(points).all()
        for pixel, point, sees in zip(pixels, points, visible, strict=True):
            expected, down = reference.back_project(camera.K, mount, where, pixel)
            assert bool(sees) == down
            if down:
                np.testing.assert_allclose(point, expected, rtol=1e-7, atol=1e-7)
        seen.extend(visible.tolist())
    assert 0.1 < np.mean(seen) < 0.95


def test_what_lies_behind_the_camera_is_not_visible(level):
    for x in (-0.001, -3.0):
        pixel, visible = floor_to_image(level, jnp.array([x, 0.2]))
        assert not visible and jnp.isfinite(pixel).all()


def test_the_horizon_is_where_depth_is_infinite(camera, level, mounts):
    np.testing.assert_allclose(horizon(level) * 270, [0, 1, -119.5], atol=1e-9)
    for mount in mounts:
        H_F = floor_homography(camera, mount, SE2.identity())
        for angle in np.linspace(0, 2 * np.pi, 7):
            at_infinity = H_F @ jnp.array([np.cos(angle), np.sin(angle), 0.0])
            np.testing.assert_allclose(horizon(H_F) @ at_infinity, 0, atol=1e-9)


def test_the_horizon_line_says_one_over_depth(camera, mount):
    H_F = floor_homography(camera, mount, SE2.identity())
    x, y, depth = H_F @ jnp.array([3.0, 0.7, 1.0])
    assert horizon(H_F) @ jnp.array([x / depth, y / depth, 1.0]) == pytest.approx(1 / float(depth))


def test_a_segment_in_range_goes_by_its_end_points(camera, mounts, rng):
    for mount in mounts:
        H_F = floor_homography(camera, mount, pose(*rng.normal(size=3)))
        points = rng.normal(size=(40, 2, 2)) * 3
        x = np.concatenate([points, np.ones((40, 2, 1))], axis=2) @ np.asarray(H_F).T
        in_range = ((x[..., 2] > 0.1) & (x[..., 2] < DEPTH)).all(axis=1)
        found, some = segments_to_floor(H_F, jnp.asarray(x[..., :2] / x[..., 2:]), DEPTH)
        assert in_range.any() and some[in_range].all()
        np.testing.assert_allclose(found[in_range], points[in_range], atol=1e-9)


def test_a_clipped_end_lies_on_the_line_at_the_greatest_depth(camera, mounts, rng):
    clipped = 0
    for mount in mounts:
        H_F = np.asarray(floor_homography(camera, mount, SE2.identity()))
        segments = rng.uniform([0, 0], [320, 240], size=(40, 2, 2))
        inside = segments @ np.linalg.inv(H_F)[2, :2] + np.linalg.inv(H_F)[2, 2] > 1 / DEPTH
        found, some = segments_to_floor(jnp.asarray(H_F), jnp.asarray(segments), DEPTH)
        np.testing.assert_array_equal(some, inside.any(axis=1))
        assert np.isfinite(found).all()
        for segment, ends, within in zip(segments, np.asarray(found), inside, strict=True):
            if within.sum() != 1:
                continue
            clipped += 1
            kept, cut = (0, 1) if within[0] else (1, 0)
            whole, _ = reference.back_project(camera.K, mount, (0, 0, 0), segment[kept])
            np.testing.assert_allclose(ends[kept], whole, atol=1e-7)
            np.testing.assert_allclose(H_F[2] @ [*ends[cut], 1], DEPTH, rtol=1e-9)
            L = H_F.T @ reference.line_through(*segment)
            assert abs(L @ [*ends[cut], 1]) < 1e-8 * np.linalg.norm(L[:2])
    assert clipped > 20


def test_a_segment_above_the_horizon_or_out_of_range_is_none_and_finite(level):
    for segment in (
        [[10, 10], [300, 100]],  # above the horizon
        [[10, 119.5], [300, 119.5]],  # on it
        [[10, 120], [300, 121]],  # below it and far
        [[159.5, 119.5], [159.5, 119.5]],  # without length
    ):
        found, some = to_floor(level, segment)
        assert not some
        assert np.isfinite(found).all()


def test_nothing_changes_where_the_cut_passes_just_beyond_an_end(level):
    edge = 119.5 + 270 / DEPTH  # the row of the greatest depth
    for row in (edge - 1e-9, edge, edge + 1e-9):
        found, some = to_floor(level, [[100, 200], [200, row]])
        assert some
        np.testing.assert_allclose(found[1], [DEPTH, -40.5 * DEPTH / 270], atol=1e-6)


def test_lines_go_by_the_transpose_and_back(camera, mounts, rng):
    for mount in mounts:
        H_F = floor_homography(camera, mount, pose(*rng.normal(size=3)))
        L = jnp.asarray(rng.normal(size=3))
        np.testing.assert_allclose(line_to_floor(H_F, line_to_image(H_F, L)), L, rtol=1e-8)


def test_the_image_of_a_floor_line_passes_through_the_images_of_its_points(camera, mounts, rng):
    for mount in mounts:
        H_F = floor_homography(camera, mount, pose(*rng.normal(size=3)))
        points = jnp.asarray(rng.normal(size=(2, 2)))
        l = line_to_image(H_F, line_through(*points))
        for point in points:
            x = H_F @ jnp.append(point, 1.0)
            assert abs(l @ x) < 1e-9 * jnp.linalg.norm(l) * jnp.linalg.norm(x)


def two_views(camera, mounts, ends, rng):
    """P and the image line of a segment of space, from a mount and two poses each."""
    for mount in mounts:
        views = []
        for _ in range(2):
            where = rng.normal(size=3)
            x = reference.in_camera(mount, where, ends) @ np.asarray(camera.K).T
            P = reference.projection_matrix(camera.K, mount, where)
            views.append((P, np.cross(*x), floor_homography(camera, mount, pose(*where))))
        yield views


def test_one_view_and_the_floor_say_of_a_floor_line_what_two_views_do(camera, mounts, rng):
    """Eq. (13) against eq. (3): the planes of both views meet the floor in the same line."""
    ends = np.array([[1.0, 2.0, 0.0], [3.0, -1.0, 0.0]])
    for views in two_views(camera, mounts, ends, rng):
        planes = reference.plane_pair(*(part for P, l, _ in views for part in (P, l)))
        for point in ends:  # the null space of L are the points of the line
            np.testing.assert_allclose(planes @ [*point, 1], 0, atol=1e-6)
        for _, l, H_F in views:
            L = np.asarray(line_to_floor(H_F, jnp.asarray(l)))
            np.testing.assert_allclose(
                np.cross(L / np.linalg.norm(L), np.cross([1, 2, 1], [3, -1, 1])), 0, atol=1e-9
            )


def test_a_line_over_the_floor_leads_each_view_to_another_floor_line(camera, mounts, rng):
    ends = np.array([[1.0, 2.0, 0.1], [3.0, -1.0, 0.1]])
    for (P, l, H_F), (P2, l2, H_F2) in two_views(camera, mounts, ends, rng):
        planes = reference.plane_pair(P, l, P2, l2)
        np.testing.assert_allclose(planes @ [*ends[0], 1], 0, atol=1e-6)
        a, b = (np.asarray(line_to_floor(H, jnp.asarray(x))) for H, x in ((H_F, l), (H_F2, l2)))
        assert np.linalg.norm(np.cross(a / np.linalg.norm(a), b / np.linalg.norm(b))) > 1e-4


def test_an_upright_line_meets_the_floor_where_its_two_floor_lines_cross(camera, mounts, rng):
    nadir = np.array([1.5, 0.4])
    ends = np.array([[*nadir, 0.3], [*nadir, 1.1]])
    for (P, l, H_F), (P2, l2, H_F2) in two_views(camera, mounts, ends, rng):
        np.testing.assert_allclose(
            reference.trace_on_floor(reference.plane_pair(P, l, P2, l2)), nadir, atol=1e-6
        )
        for H, x in ((H_F, l), (H_F2, l2)):
            L = line_to_floor(H, jnp.asarray(x))
            assert abs(L @ jnp.append(nadir, 1.0)) < 1e-8 * jnp.linalg.norm(L)


def test_uprights_point_to_the_nadir_and_lines_of_the_floor_beside_it_do_not(camera, mounts):
    for mount in mounts:
        T, nadir, ahead = SE2.identity(), mount.T_robot_nadir.xy, SE2(jnp.zeros(2), mount.yaw)
        H_F, P = floor_homography(camera, mount, T), projection_matrix(camera, mount, T)
        nadir_image = H_F @ jnp.append(nadir, 1.0)
        place = nadir + ahead.apply(jnp.array([2.0, 0.7]))
        edge = jnp.array([[*place, 0.1, 1.0], [*place, 0.6, 1.0]]) @ P.T
        edge = edge[:, :2] / edge[:, 2:]
        assert may_be_upright(nadir_image, edge, 1e-6)
        for y, pointing in ((0.0, True), (0.3, False), (-0.3, False)):
            ends = nadir + ahead.apply(jnp.array([[2.0, y], [3.0, y]]))
            on_floor, before = to_image(H_F, ends)
            assert before.all() and may_be_upright(nadir_image, on_floor, 1.0) == pointing
            assert not may_be_upright(nadir_image, on_floor, 0.0)


def test_float32_is_good_to_a_millimetre_at_five_metres(camera, mount, rng):
    H_F = floor_homography(camera, mount, SE2.identity())
    points = jnp.asarray(rng.uniform([0.5, -2], [5, 2], size=(100, 2)))
    pixels, _ = to_image(H_F, points)
    with jax.enable_x64(False):
        back, _ = jax.vmap(image_to_floor, (None, 0))(
            H_F.astype("float32"), pixels.astype("float32")
        )
    np.testing.assert_allclose(back, points, atol=1e-3)
