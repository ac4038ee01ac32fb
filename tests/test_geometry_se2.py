"""SE2 is the group of rigid motions of the floor."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from sofjax.geometry import SE2

pytestmark = pytest.mark.usefixtures("x64")


def pose(x, y, yaw):
    return SE2(jnp.array([x, y], float), jnp.array(yaw, float))


@pytest.fixture
def poses(rng):
    return [pose(*rng.normal(size=2), rng.uniform(-3, 3)) for _ in range(3)]


def matrix(T):
    return reference.pose_matrix([*T.xy, T.yaw])


def assert_same(a, b, turns=False):
    np.testing.assert_allclose(a.xy, b.xy, atol=1e-12)
    difference = float(a.yaw - b.yaw)
    if turns:
        difference -= 2 * np.pi * round(difference / (2 * np.pi))
    assert abs(difference) < 1e-12


def test_a_pose_worked_by_hand():
    T_world_robot = pose(1, 2, np.pi / 2)
    np.testing.assert_allclose(T_world_robot.apply(jnp.array([1.0, 0.0])), [1, 3], atol=1e-12)
    np.testing.assert_allclose(T_world_robot.rotate(jnp.array([0.0, 1.0])), [-1, 0], atol=1e-12)
    assert_same(T_world_robot @ pose(2, 0, np.pi / 2), pose(1, 4, np.pi))


def test_composition_is_the_product_of_matrices(poses):
    A, B, _ = poses
    np.testing.assert_allclose(matrix(A @ B), matrix(A) @ matrix(B), atol=1e-12)
    np.testing.assert_allclose(matrix(A.inverse()), np.linalg.inv(matrix(A)), atol=1e-12)


def test_composition_acts_as_one_after_the_other(poses, rng):
    A, B, _ = poses
    points = jnp.asarray(rng.normal(size=(5, 2)))
    np.testing.assert_allclose((A @ B).apply(points), A.apply(B.apply(points)), atol=1e-12)


def test_composition_is_associative(poses):
    A, B, C = poses
    assert_same((A @ B) @ C, A @ (B @ C))


def test_identity_changes_nothing(poses):
    for A in poses:
        assert_same(A @ SE2.identity(), A)
        assert_same(SE2.identity() @ A, A)


def test_inverse_takes_back(poses):
    for A in poses:
        assert_same(A @ A.inverse(), SE2.identity())
        assert_same(A.inverse() @ A, SE2.identity())


def test_between_is_the_motion_from_one_pose_to_the_other(poses):
    A, B, _ = poses
    assert_same(A @ A.between(B), B)
    assert_same(A.between(A), SE2.identity())


def test_paths_keep_their_turns():
    quarter = pose(0, 0, np.pi / 2)
    T = SE2.identity()
    for _ in range(9):
        T = T @ quarter
    assert float(T.yaw) == pytest.approx(4.5 * np.pi)


def test_a_batch_is_each_of_its_poses(poses, rng):
    many = jax.tree.map(lambda *a: jnp.stack(a), *poses)
    points = jnp.asarray(rng.normal(size=(3, 2)))
    np.testing.assert_allclose(
        many.apply(points), jnp.stack([T.apply(p) for T, p in zip(poses, points, strict=True)])
    )
    twice, back = many @ many, many.inverse()
    for i, T in enumerate(poses):
        assert_same(SE2(twice.xy[i], twice.yaw[i]), T @ T)
        assert_same(SE2(back.xy[i], back.yaw[i]), T.inverse())
        np.testing.assert_allclose(many.log()[i], T.log())


def test_an_arc_worked_by_hand():
    assert_same(SE2.exp(jnp.array([np.pi / 2, 0, np.pi / 2])), pose(1, 1, np.pi / 2))
    assert_same(SE2.exp(jnp.array([2.0, 1.0, 0.0])), pose(2, 1, 0))


OMEGAS = [0.0, 1e-12, 1e-5, 0.999e-3, 1.001e-3, 0.3, 3.0, np.pi]


@pytest.mark.parametrize("omega", [s * w for w in OMEGAS for s in (1, -1)])
def test_exp_is_many_small_steps(omega):
    step = reference.pose_matrix(np.array([0.7, -0.2, omega]) / 2**20)
    arc = SE2.exp(jnp.array([0.7, -0.2, omega]))
    np.testing.assert_allclose(matrix(arc), np.linalg.matrix_power(step, 2**20), atol=2e-6)


@pytest.mark.parametrize("omega", [s * w for w in OMEGAS for s in (1, -1)])
def test_log_undoes_exp_and_exp_log(omega):
    twist = jnp.array([0.7, -0.2, omega])
    T = SE2.exp(twist)
    assert_same(SE2.exp(T.log()), T, turns=True)
    if abs(omega) < np.pi:
        np.testing.assert_allclose(T.log(), twist, atol=1e-12)


def test_log_of_many_turns_is_that_of_the_wrapped_yaw():
    np.testing.assert_allclose(pose(1, 2, 0.3 + 4 * np.pi).log(), pose(1, 2, 0.3).log(), atol=1e-12)


def test_exp_of_twists_of_one_axis_add_up():
    twist = jnp.array([0.7, -0.2, 0.4])
    assert_same(SE2.exp(twist) @ SE2.exp(2 * twist), SE2.exp(3 * twist))
