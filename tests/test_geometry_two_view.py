"""The homography that the floor induces between two images; eqs. (4) to (8)."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from conftest import as_float32

from sofjax.geometry import SE2, Mount, floor_homography, two_view_homography
from sofjax.geometry.two_view import transfer_segment

pytestmark = pytest.mark.usefixtures("x64")


def motion(x, y, yaw):
    return SE2(jnp.array([x, y], float), jnp.array(yaw, float))


@pytest.fixture
def motions(rng):
    return [motion(*(rng.normal(size=3) * [0.5, 0.5, 1])) for _ in range(8)]


def test_driving_ahead_worked_by_hand(camera):
    # 1 m over the floor, looking straight ahead: 2 m ahead is row 135 below the centre, 1 m row 270
    H = two_view_homography(camera, Mount.create(height=1.0), motion(1, 0, 0))
    x, y, ratio = H @ jnp.array([159.5 - 27, 119.5 + 135, 1.0])
    np.testing.assert_allclose([x / ratio, y / ratio], [159.5 - 54, 119.5 + 270])
    assert ratio == pytest.approx(1 / 2)  # of the depths


def test_two_view_homography_is_one_floor_homography_after_the_inverse_of_the_other(
    camera, mounts, motions, rng
):
    """Tilted, rolled and turned mounts with lever arms; equal in scale too."""
    for mount, T_first_second in zip(mounts, motions, strict=True):
        first = motion(*rng.normal(size=3))
        H_F, H_F2 = (floor_homography(camera, mount, T) for T in (first, first @ T_first_second))
        H = two_view_homography(camera, mount, T_first_second)
        np.testing.assert_allclose(H @ H_F, H_F2, atol=1e-8)
        np.testing.assert_allclose(H, H_F2 @ jnp.linalg.inv(H_F), rtol=1e-6, atol=1e-6)


def test_no_motion_is_the_identity(camera, mounts):
    for mount in mounts:
        H = two_view_homography(camera, mount, SE2.identity())
        np.testing.assert_allclose(H, np.eye(3), atol=1e-10)


def test_two_motions_are_the_product_of_their_homographies(camera, mount, motions):
    for A, B in itertools.pairwise(motions):
        H, H_A, H_B = (two_view_homography(camera, mount, T) for T in (A @ B, A, B))
        np.testing.assert_allclose(H, H_B @ H_A, atol=1e-8)


def test_the_motion_back_is_the_inverse(camera, mounts, motions):
    for mount, T in zip(mounts, motions, strict=True):
        back = two_view_homography(camera, mount, T.inverse())
        np.testing.assert_allclose(
            back @ two_view_homography(camera, mount, T), np.eye(3), atol=1e-8
        )


def test_only_the_ratio_of_lengths_to_the_height_matters(camera, motions):
    small = Mount.create(height=0.5, pitch=0.3, x=0.1, y=-0.04, roll=0.1, yaw=0.2)
    large = Mount.create(height=1.0, pitch=0.3, x=0.2, y=-0.08, roll=0.1, yaw=0.2)
    for T in motions:
        double = SE2(2 * T.xy, T.yaw)
        np.testing.assert_allclose(
            two_view_homography(camera, large, double),
            two_view_homography(camera, small, T),
            atol=1e-9,
        )


def test_turning_on_the_spot_is_a_pure_rotation_only_without_a_lever_arm(camera):
    turn = motion(0, 0, 0.5)
    K = np.asarray(camera.K)
    for arm in (0.0, 0.2):
        mount = Mount.create(height=0.6, pitch=0.3, x=arm)
        R, _ = reference.camera_axes_and_centre(mount, (0, 0, 0))
        R2, _ = reference.camera_axes_and_centre(mount, (0, 0, 0.5))
        rotation = K @ R2.T @ R @ np.linalg.inv(K)
        distance = np.abs(two_view_homography(camera, mount, turn) - rotation).max()
        assert distance < 1e-9 if arm == 0 else distance > 1


def test_a_floor_segment_goes_where_the_second_camera_sees_it(camera, mounts, motions, rng):
    seen = 0
    for mount, T in zip(mounts, motions, strict=True):
        H = two_view_homography(camera, mount, T)
        second = [*T.xy, float(T.yaw)]
        for ends in rng.normal(size=(40, 2, 2)) * 3:
            ends = np.column_stack([ends, np.zeros(2)])
            before, depth = reference.project(camera.K, mount, (0, 0, 0), ends)
            after, depth2 = reference.project(camera.K, mount, second, ends)
            if (depth > 0.1).all() and (depth2 > 0.06 * depth).all():
                seen += 1
                found, some = transfer_segment(H, jnp.asarray(before))
                assert some
                np.testing.assert_allclose(found, after, rtol=1e-6, atol=1e-6)
    assert seen > 20


def test_what_the_robot_drove_past_is_behind_the_camera(camera):
    level = Mount.create(height=1.0)
    H = two_view_homography(camera, level, motion(3, 0, 0))
    ends = np.array([[2.0, -0.5, 0], [2.5, 0.5, 0]])  # between the two places
    before, _ = reference.project(camera.K, level, (0, 0, 0), ends)
    found, some = transfer_segment(H, jnp.asarray(before))
    assert not some
    assert jnp.isfinite(found).all()


def test_the_part_still_ahead_is_kept_and_lies_on_the_line(camera):
    level = Mount.create(height=1.0)
    H = two_view_homography(camera, level, motion(3, 0, 0))
    ends = np.array([[2.0, 0.3, 0], [5.0, 0.9, 0]])
    before, _ = reference.project(camera.K, level, (0, 0, 0), ends)
    for kept, cut, segment in ((1, 0, before), (0, 1, before[::-1])):
        found, some = transfer_segment(H, jnp.asarray(segment))
        assert some
        after, _ = reference.project(camera.K, level, (3, 0, 0), ends)
        np.testing.assert_allclose(found[kept], after[1], atol=1e-8)
        # the cut end: 20 times nearer after the motion than before
        floor, down = reference.back_project(camera.K, level, (3, 0, 0), found[cut])
        assert down and floor[0] - 3 == pytest.approx(0.05 * floor[0])
        assert floor[1] == pytest.approx(0.3 + 0.2 * (floor[0] - 2))


def test_a_transfer_is_the_reference_at_every_ratio(rng):
    for _ in range(50):
        H = np.eye(3) + 0.3 * rng.normal(size=(3, 3))
        segment = rng.normal(size=(2, 2)) * 3
        found, some = transfer_segment(jnp.asarray(H), jnp.asarray(segment))
        expected = reference.transfer_segment(H, segment)
        assert bool(some) == (expected is not None)
        if expected is not None:
            np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)


def test_float32_transfers_to_a_tenth_of_a_pixel(camera, mount, rng):
    T = motion(0.3, 0.02, 0.2)
    ends = jnp.asarray(rng.uniform([0, 80], [320, 240], size=(100, 2, 2)))
    exact, some = jax.vmap(transfer_segment, (None, 0))(two_view_homography(camera, mount, T), ends)
    with jax.enable_x64(False):
        H = two_view_homography(as_float32(camera), as_float32(mount), as_float32(T))
        found, _ = jax.vmap(transfer_segment, (None, 0))(H, as_float32(ends))
    assert some.all()
    np.testing.assert_allclose(found, exact, atol=0.1)
