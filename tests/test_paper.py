"""The paper, equation by equation: what each says, and where it cannot be meant as it stands.

G. Zhang and I. H. Suh, SoF-SLAM: Segments-on-Floor-based Monocular SLAM. Its robot: a camera
1 m over the floor, 320 by 240 pixels, facing forward. The laws behind the equations are tested
beside the modules, eq. (14) and the rules of III.B beside the map; here are the numbers that a
reader with the paper can follow.
"""

import jax.numpy as jnp
import numpy as np
import pytest
import reference
from conftest import jit_quickly

from sofjax.extraction.association import Association, association_error
from sofjax.extraction.sof import extract
from sofjax.geometry import (
    SE2,
    Mount,
    Segments,
    floor_homography,
    image_to_floor,
    line_through,
    line_to_floor,
    polar,
    projection_matrix,
    transfer_line,
    two_view_homography,
)
from sofjax.slam.presets import DEFAULT, PAPER

pytestmark = pytest.mark.usefixtures("x64")


@pytest.fixture
def forward():
    """The paper's mount."""
    return Mount.create(height=1.0)


@pytest.fixture
def tilted():
    return Mount.create(height=0.6, pitch=0.3, x=0.1, roll=0.05, yaw=-0.1)


def robot(x=0.0, y=0.0, yaw=0.0):
    return SE2(jnp.array([x, y], float), jnp.array(yaw, float))


def same_up_to_scale(a, b):
    a, b = (np.asarray(m) / np.linalg.norm(m) for m in (a, b))
    np.testing.assert_allclose(a * np.sign(np.sum(a * b)), b, atol=1e-9)


def test_eq_1_x_is_P_X(camera, forward):
    x = projection_matrix(camera, forward, robot()) @ jnp.array([4.0, 1.0, 0.0, 1.0])
    np.testing.assert_allclose(x[:2] / x[2], [159.5 - 270 / 4, 119.5 + 270 / 4])


def test_eq_2_P_is_K_R_times_I_and_minus_C(camera, tilted):
    P = projection_matrix(camera, tilted, robot(1, 2, 0.5))
    R_world_camera, C = reference.camera_axes_and_centre(tilted, (1, 2, 0.5))
    np.testing.assert_allclose(P[:, :3], camera.K @ R_world_camera.T)
    np.testing.assert_allclose(P @ jnp.array([*C, 1.0]), 0, atol=1e-9)  # C has no image


def test_text_of_II_A_a_line_is_the_cross_product_of_its_points():
    x1, x2 = jnp.array([3.0, 1.0]), jnp.array([-2.0, 5.0])
    l = line_through(x1, x2)
    for x in (x1, x2, (x1 + x2) / 2):
        assert l @ jnp.append(x, 1.0) == pytest.approx(0)


def test_text_of_II_A_rho_is_the_distance_and_theta_the_angle_to_the_horizontal_axis():
    line = polar(line_through(jnp.array([0.0, 2.0]), jnp.array([2.0, 4.0])))
    assert (abs(line.rho), line.theta) == (pytest.approx(np.sqrt(2)), pytest.approx(np.pi / 4))


def test_text_of_II_A_lines_go_by_the_inverse_transpose(rng):
    H, l = jnp.asarray(rng.normal(size=(3, 3))), jnp.asarray(rng.normal(size=3))
    same_up_to_scale(transfer_line(H, l), np.linalg.inv(H).T @ l)


def test_eq_3_two_views_are_two_planes_through_the_line(camera, tilted):
    ends = np.array([[2.0, 1.0, 0.0], [3.0, -1.0, 0.0]])
    views = []
    for where in ((0, 0, 0), (0.4, 0.1, 0.2)):
        pixels, _ = reference.project(camera.K, tilted, where, ends)
        views += [
            projection_matrix(camera, tilted, robot(*where)),
            line_through(*jnp.asarray(pixels)),
        ]
    L = reference.plane_pair(*map(np.asarray, views))
    assert L.shape == (2, 4)
    for X in ends:
        np.testing.assert_allclose(L @ [*X, 1] / np.linalg.norm(L, axis=1), 0, atol=1e-9)


def test_eqs_4_and_5_the_first_camera_is_the_origin(camera, tilted):
    """R̄ and t̄ take the first camera's nadir into the second's."""
    motion = robot(0.4, 0.1, 0.2)
    nadir = np.array([0.1, 0.0])
    X = np.array([2.0, 0.5])  # on the floor, in the axes of the robot, from the first nadir
    R, t = reference.rotation("z", -0.2)[:2, :2], motion.inverse().apply(jnp.asarray(nadir)) - nadir
    second_nadir = motion.apply(jnp.asarray(nadir))
    expected = R @ (X + nadir - second_nadir)
    np.testing.assert_allclose(R @ X + t, expected, atol=1e-12)


def test_eq_6_the_floor_is_n_X_plus_h(tilted):
    """In axes of the world about the camera's centre every floor point has n·X + h = 0."""
    _, C = reference.camera_axes_and_centre(tilted, (0, 0, 0))
    for X in ([1.0, 2.0, 0.0], [-3.0, 0.5, 0.0]):
        assert np.dot([0, 0, 1], np.array(X) - C) + float(tilted.height) == pytest.approx(0)


def test_eq_7_in_the_axes_of_the_body(camera, tilted):
    """K and the tilt taken off, the homography is R̄ - t̄ nᵀ / h."""
    K = np.asarray(camera.K)
    R_robot_camera, _ = reference.camera_axes_and_centre(tilted, (0, 0, 0))
    to_body = R_robot_camera @ np.linalg.inv(K)
    H = to_body @ two_view_homography(camera, tilted, robot(0.4, 0.1, 0.2)) @ np.linalg.inv(to_body)
    back = reference.pose_matrix((0.4, 0.1, 0.2))
    t = (np.linalg.inv(back) @ [0.1, 0, 1])[:2] - [0.1, 0]
    expected = reference.rotation("z", -0.2) - np.outer([*t, 0], [0, 0, 1]) / 0.6
    np.testing.assert_allclose(H, expected, atol=1e-9)


def eq_8(camera, mount, motion, h):
    """K (R̄ - [0 0 t̄] / h) K^-1 as printed, with R̄ and t̄ in the axes of the camera."""
    K = np.asarray(camera.K)
    R_robot_camera, C = reference.camera_axes_and_centre(mount, (0, 0, 0))
    R_second, C_second = reference.camera_axes_and_centre(mount, [*motion.xy, float(motion.yaw)])
    R, t = R_second.T @ R_robot_camera, R_second.T @ (C - C_second)
    return K @ (R - np.column_stack([np.zeros((3, 2)), t]) / h) @ np.linalg.inv(K)


def test_eq_8_as_printed_is_for_a_camera_whose_axis_is_the_normal_of_the_floor(camera):
    """Looking straight up, n = (0, 0, 1); straight down n points at the camera: h counts as -h."""
    motion = robot(0.3, -0.1, 0.4)
    for pitch, sign in ((-np.pi / 2, 1), (np.pi / 2, -1)):
        upright = Mount.create(height=1.0, pitch=pitch, x=0.1)
        H = two_view_homography(camera, upright, motion)
        np.testing.assert_allclose(H, eq_8(camera, upright, motion, sign * 1.0), atol=1e-8)


def test_eq_8_as_printed_is_not_for_a_camera_that_faces_forward(camera, forward):
    motion = robot(0.3, 0.0, 0.0)
    ends = np.array([[3.0, 1.0, 0.0]])
    before, after = (
        reference.project(camera.K, forward, where, ends)[0][0]
        for where in ((0, 0, 0), (0.3, 0, 0))
    )
    for H, misses in (
        (two_view_homography(camera, forward, motion), False),
        (eq_8(camera, forward, motion, 1.0), True),
    ):
        x = H @ jnp.append(jnp.asarray(before), 1.0)
        assert (np.linalg.norm(x[:2] / x[2] - after) > 5) == misses


def test_eq_8_is_one_H_F_after_the_inverse_of_the_other(camera, tilted):
    first, motion = robot(1, 2, 3), robot(0.3, -0.1, 0.4)
    H_F, H_F2 = (floor_homography(camera, tilted, T) for T in (first, first @ motion))
    same_up_to_scale(two_view_homography(camera, tilted, motion), H_F2 @ jnp.linalg.inv(H_F))


def error(camera, first, second):
    config = Association(alpha=1.0, beta=60.0)
    ends = (jnp.asarray(s, float) + jnp.array([159.5, 119.5]) for s in (first, second))
    return float(association_error(config, camera, jnp.eye(3), *ends))


def test_eq_9_weighs_the_difference_in_rho_and_in_theta(camera):
    across, lower = [[-50, 40], [50, 40]], [[-50, 43], [50, 43]]
    assert error(camera, across, lower) == pytest.approx(3)
    through = [[-50, 0], [50, 0]]
    turned = [[-50, -5], [50, 5]]
    assert error(camera, through, turned) == pytest.approx(60 * np.arctan(0.1))


def test_eq_9_as_printed_lets_two_errors_cancel(camera):
    """Signed, alpha (rho' - rho'') + beta (theta' - theta'') is zero for these two lines."""
    first = [[-50, 40], [50, 40]]
    d_theta = 0.1
    rho = 40 - 60 * d_theta
    d, n = np.array([np.cos(d_theta), np.sin(d_theta)]), [-np.sin(d_theta), np.cos(d_theta)]
    second = rho * np.array(n) + 50 * np.array([-d, d])
    printed = (rho - 40) + 60 * (d_theta - 0)
    assert printed == pytest.approx(0)
    assert error(camera, first, second) == pytest.approx(12)


def test_text_below_eq_9_segments_overlap_in_the_direction_of_the_second(camera):
    first = [[-50, 40], [0, 40]]
    assert error(camera, first, [[-10, 40], [50, 40]]) == pytest.approx(0)
    assert error(camera, first, [[10, 40], [50, 40]]) == np.inf


def test_eqs_10_and_11_the_floor_needs_three_columns_of_P(camera, tilted):
    P = projection_matrix(camera, tilted, robot(1, 2, 0.5))
    H_F = floor_homography(camera, tilted, robot(1, 2, 0.5))
    for X, Y in ((2.0, 3.0), (-1.0, 0.5)):
        np.testing.assert_allclose(H_F @ jnp.array([X, Y, 1.0]), P @ jnp.array([X, Y, 0.0, 1.0]))


def test_eq_12_a_pixel_is_put_on_the_floor_by_the_inverse(camera, forward):
    point, visible = image_to_floor(
        floor_homography(camera, forward, robot()), jnp.array([159.5 - 67.5, 119.5 + 67.5])
    )
    np.testing.assert_allclose(point, [4, 1])
    assert visible


def test_eq_13_a_line_is_put_on_the_floor_by_the_transpose(camera, forward):
    H_F = floor_homography(camera, forward, robot())
    row_90 = line_through(jnp.array([0.0, 119.5 + 90]), jnp.array([300.0, 119.5 + 90]))
    L = polar(line_to_floor(H_F, row_90))  # 270 / 90 m ahead, across
    assert (abs(L.rho), abs(L.theta)) == (pytest.approx(3), pytest.approx(np.pi / 2))


def test_eq_13_says_of_floor_lines_what_eq_3_does(camera, tilted):
    """Both planes of eq. (3) meet the floor in the line of eq. (13)."""
    ends = np.array([[2.0, 1.0, 0.0], [3.0, -1.0, 0.0]])
    pixels, _ = reference.project(camera.K, tilted, (0, 0, 0), ends)
    l = line_through(*jnp.asarray(pixels))
    plane = l @ projection_matrix(camera, tilted, robot())
    L = line_to_floor(floor_homography(camera, tilted, robot()), l)
    same_up_to_scale(L, plane[jnp.array([0, 1, 3])])  # the plane with Z = 0
    same_up_to_scale(L, np.cross([2, 1, 1], [3, -1, 1]))


def test_fig_5_finds_the_floor_s_segments_of_two_images(camera, forward):
    """A line on the floor, one at the height of a skirting board, one beyond the horizon."""
    world = np.array(
        [[[3, -1, 0], [3, 1, 0]], [[3, -1, 0.15], [3, 1, 0.15]], [[3, -1, 1.5], [3, 1, 1.5]]]
    )
    first, second = (
        Segments(
            jnp.asarray(
                np.array(
                    [reference.project(camera.K, forward, (x, 0, 0), ends)[0] for ends in world]
                )
            ),
            jnp.ones(3, bool),
        )
        for x in (0.0, 0.8)
    )
    found = jit_quickly(extract)(Association(gate=2.0), camera, forward, first, second, robot(0.8))
    np.testing.assert_array_equal(found.is_floor, [True, False, False])
    np.testing.assert_allclose(found.segments_robot.endpoints[0], [[2.2, -1], [2.2, 1]], atol=1e-9)


def test_the_paper_s_settings_are_the_paper_s():
    assert (PAPER.segment_map.range, PAPER.segment_map.length) == (5.0, 10.0)  # R, L = 2 R
    assert PAPER.segment_map.rule == "gamma"  # eq. (14)
    assert not PAPER.segment_map.classify  # every line on the floor
    assert PAPER.filter.choice == "winner"  # a single most likely particle
    assert PAPER.filter.gate_each  # Fig. 6, step 4: SoF for each hypothetical position
    assert not PAPER.sensor.propagate  # one Gaussian for rho and theta
    assert PAPER.association.baseline_distance == 0  # consecutive images
    assert DEFAULT.segment_map.length == 2 * DEFAULT.segment_map.range
