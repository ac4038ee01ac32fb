"""The camera, its mount and P; eqs. (1) and (2), and the conventions of the frames."""

import jax.numpy as jnp
import numpy as np
import pytest
import reference

from sofjax.geometry import SE2, Mount, projection_matrix
from sofjax.geometry.camera import rotation_robot_camera

pytestmark = pytest.mark.usefixtures("x64")


def project(camera, mount, point, pose=(0.0, 0.0, 0.0)):
    T_world_robot = SE2(jnp.array(pose[:2], float), jnp.array(pose[2], float))
    x, y, depth = projection_matrix(camera, mount, T_world_robot) @ jnp.array([*point, 1.0])
    return np.array([x, y]) / depth, float(depth)


def test_projection_worked_by_hand(camera):
    # 1 m up and looking straight ahead: the floor 2 m ahead is 270 / 2 px below the centre
    level = Mount.create(height=1.0)
    pixel, depth = project(camera, level, (2, 0, 0))
    np.testing.assert_allclose(pixel, [159.5, 119.5 + 135])
    assert depth == pytest.approx(2)
    pixel, depth = project(camera, level, (2, 1, 1.5))  # left is left, up is up
    np.testing.assert_allclose(pixel, [159.5 - 135, 119.5 - 67.5])


def test_a_turned_robot_worked_by_hand(camera):
    # at (3, 1), facing +Y, with the camera 20 cm ahead of the axle: at (3, 1.2)
    arm = Mount.create(height=1.0, x=0.2)
    pixel, depth = project(camera, arm, (3.5, 3.2, 0), pose=(3, 1, np.pi / 2))
    np.testing.assert_allclose(pixel, [159.5 + 67.5, 119.5 + 135])
    assert depth == pytest.approx(2)


def test_pitch_above_zero_looks_down(camera):
    mount = Mount.create(height=0.6, pitch=0.3)
    pixel, _ = project(camera, mount, (0.6 / np.tan(0.3), 0, 0))
    np.testing.assert_allclose(pixel, [159.5, 119.5])


def test_yaw_above_zero_looks_left(camera):
    mount = Mount.create(height=0.6, yaw=0.3)
    pixel, _ = project(camera, mount, (np.cos(0.3), np.sin(0.3), 0.6))
    np.testing.assert_allclose(pixel, [159.5, 119.5])


def test_roll_above_zero_lifts_the_left_of_the_camera(camera):
    mount = Mount.create(height=0.6, roll=0.3)
    left_of_camera, _ = project(camera, mount, (2, np.cos(0.3), 0.6 + np.sin(0.3)))
    np.testing.assert_allclose(left_of_camera, [159.5 - 135, 119.5])


def test_turning_on_the_spot_moves_the_camera_by_its_lever_arm():
    arm = Mount.create(height=1.0, x=0.1)
    nadirs = [SE2(jnp.zeros(2), jnp.array(yaw)) @ arm.T_robot_nadir for yaw in (0.0, np.pi / 2)]
    assert jnp.linalg.norm(nadirs[1].xy - nadirs[0].xy) == pytest.approx(0.1 * np.sqrt(2))


def test_the_camera_axes_are_a_rotation(mounts):
    for mount in mounts:
        R = rotation_robot_camera(mount)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert jnp.linalg.det(R) == pytest.approx(1)


def test_projection_is_the_reference_and_its_third_component_the_depth(camera, mounts, rng):
    for mount in mounts:
        pose = rng.normal(size=3)
        points = rng.normal(size=(10, 3)) * 3
        T_world_robot = SE2(jnp.asarray(pose[:2]), jnp.asarray(pose[2]))
        x = (
            jnp.column_stack([points, np.ones(10)])
            @ projection_matrix(camera, mount, T_world_robot).T
        )
        pixels, depth = reference.project(camera.K, mount, pose, points)
        np.testing.assert_allclose(x[:, 2], depth, atol=1e-12)
        np.testing.assert_allclose(x[:, :2], pixels * depth[:, None], atol=1e-9)


def test_moving_robot_and_world_together_changes_no_image(camera, mount, rng):
    pose, move = rng.normal(size=(2, 3))
    points = rng.normal(size=(5, 3))
    moved = np.column_stack([points[:, :2], np.ones(5)]) @ reference.pose_matrix(move).T
    moved[:, 2] = points[:, 2]
    there = reference.pose_of(reference.pose_matrix(move) @ reference.pose_matrix(pose))
    for point, point_moved in zip(points, moved, strict=True):
        before, depth = project(camera, mount, point, pose)
        after, depth_after = project(camera, mount, point_moved, there)
        np.testing.assert_allclose(after, before, rtol=1e-9)
        assert depth_after == pytest.approx(depth)
