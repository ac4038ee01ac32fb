"""The smoother's arrow shape against dense algebra, and its solution against a known world."""

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from sofjax.geometry import SE2, Camera, Mount, Segments, floor_homography, floor_to_image
from sofjax.motion import MotionModel
from sofjax.smoothing import Keyframes, Priors, Problem, Unknowns, residuals, solve
from sofjax.smoothing.arrow import assemble

pytestmark = pytest.mark.slow  # compiles in double precision, minutes on a busy machine

N, K = 6, 7


@pytest.fixture(scope="module")
def problem():
    """A robot drives an arc over lines in all directions, with a little noise in the start."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        camera = Camera(jnp.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]), 320, 240)
        mount = Mount(*(jnp.asarray(v) for v in (0.1, 0.02, 0.8, 0.3, 0.01, -0.02)))
        pose = np.zeros((N, 5))
        pose[:, 0] = 0.25 * np.arange(N)
        pose[:, 1] = 0.05 * np.arange(N)
        pose[:, 2] = 0.06 * np.arange(N)
        line = np.stack([rng.uniform(-1, 3, K), rng.uniform(0, np.pi, K), np.ones(K)], axis=1)
        anchor = SE2(jnp.zeros((K, 2)), jnp.zeros(K))
        n = np.stack([-np.sin(line[:, 1]), np.cos(line[:, 1])], axis=1)
        d = np.stack([np.cos(line[:, 1]), np.sin(line[:, 1])], axis=1)
        middle = line[:, :1] * n
        shift = ((np.array([2.5, 0]) - middle) * d).sum(1, keepdims=True) * d
        ends = middle[:, None] + shift[:, None] + np.array([-0.3, 0.3])[:, None] * d[:, None]

        def seen(p):
            H_F = floor_homography(camera, mount, SE2(p[:2], p[2]))
            project = jax.vmap(jax.vmap(floor_to_image, (None, 0)), (None, 0))
            return project(H_F, jnp.asarray(ends))

        image, ahead = jax.vmap(seen)(jnp.asarray(pose))
        known = np.asarray(ahead).all(-1)
        known[0, 0] = False  # padding in the middle
        T = SE2(jnp.asarray(pose[:, :2]), jnp.asarray(pose[:, 2]))
        before = jax.tree.map(lambda a: jnp.concatenate([a[:1], a[:-1]]), T)
        motion = before.between(T)
        way = jnp.stack(
            [jnp.linalg.norm(motion.xy, axis=1), jnp.maximum(motion.yaw, 0), 0 * motion.yaw], axis=1
        )
        noise = np.zeros((N, 5))
        noise[1:, :3] = rng.normal(0, 0.02, (N - 1, 3))
        start = Unknowns(
            jnp.asarray(pose + noise),
            jnp.asarray(line + rng.normal(0, 1, line.shape) * [0.03, 0.02, 0]),
            jnp.zeros(8),
        )
        index = jnp.broadcast_to(jnp.arange(K), (N, K))
        keyframes = Keyframes(
            Segments(image, jnp.ones((N, K), bool)), index, jnp.asarray(known), motion, way
        )
        raised = jnp.zeros(K, bool).at[2].set(True)
        problem = Problem(camera, mount, MotionModel(), Priors(), keyframes, anchor, raised, start)
        return problem, pose


def _dense(problem, unknowns):
    flat, restore = jax.flatten_util.ravel_pytree(unknowns)
    J = jax.jacfwd(lambda x: jax.flatten_util.ravel_pytree(residuals(restore(x), problem))[0])(flat)
    return np.asarray(J.T @ J)


def test_assembled_blocks_are_those_of_the_dense_normal_equations(problem):
    problem, _ = problem
    with jax.enable_x64(True):
        u = problem.start
        _, jvp = jax.linearize(lambda v: residuals(v, problem), u)
        arrow = assemble(jvp, problem.keyframes, u, 0.25)
        dense = _dense(problem, u) + 0.25 * np.eye(5 * N + 3 * K + 8)
        P = 5 * N
        band = np.zeros((P, P))
        for i in range(N):
            band[5 * i : 5 * i + 5, 5 * i : 5 * i + 5] = arrow.diagonal[i]
            if i + 1 < N:
                band[5 * i : 5 * i + 5, 5 * i + 5 : 5 * i + 10] = arrow.upper[i]
                band[5 * i + 5 : 5 * i + 10, 5 * i : 5 * i + 5] = arrow.upper[i].T
        scale = np.sqrt(np.outer(np.diag(dense), np.diag(dense)))
        np.testing.assert_allclose(band / scale[:P, :P], dense[:P, :P] / scale[:P, :P], atol=1e-12)
        border = np.asarray(arrow.border).reshape(P, -1)
        np.testing.assert_allclose(
            border / scale[:P, P:], dense[:P, P:] / scale[:P, P:], atol=1e-12
        )
        corner = np.asarray(arrow.corner)
        np.testing.assert_allclose(
            corner / scale[P:, P:], dense[P:, P:] / scale[P:, P:], atol=1e-12
        )


def test_a_step_of_the_arrow_solves_the_dense_equations(problem):
    problem, _ = problem
    with jax.enable_x64(True):
        u = problem.start
        _, jvp = jax.linearize(lambda v: residuals(v, problem), u)
        arrow = assemble(jvp, problem.keyframes, u, 1.0)
        rng = np.random.default_rng(1)
        pose, rest = rng.normal(size=(N, 5)), rng.normal(size=3 * K + 8)
        x, y = arrow.solve(jnp.asarray(pose), jnp.asarray(rest))
        dense = _dense(problem, u) + np.eye(5 * N + 3 * K + 8)
        want = np.linalg.solve(dense, np.concatenate([pose.ravel(), rest]))
        got = np.concatenate([np.ravel(x), y])
        np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-9 * np.abs(want).max())


def test_solution_is_that_of_a_dense_solver_and_finds_the_path(problem):
    problem, pose = problem
    with jax.enable_x64(True):
        ours = solve(problem)
        assert bool(ours.converged)
        np.testing.assert_allclose(ours.unknowns.pose[:, :3], pose[:, :3], atol=5e-3)
        solver = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)
        dense = optx.least_squares(residuals, solver, problem.start, problem, max_steps=100)
        np.testing.assert_allclose(ours.unknowns.pose, dense.value.pose, atol=2e-5)
        np.testing.assert_allclose(ours.unknowns.line, dense.value.line, atol=2e-4)


def test_marginal_covariances_are_those_of_the_dense_inverse(problem):
    problem, _ = problem
    with jax.enable_x64(True):
        ours = solve(problem)
        scale = np.linalg.inv(_dense(problem, ours.unknowns))
        for i in range(N):
            want = scale[5 * i : 5 * i + 5, 5 * i : 5 * i + 5]
            np.testing.assert_allclose(ours.pose_covariance[i], want, rtol=1e-4, atol=1e-12)
        k = 5 * N + 3 * 2
        np.testing.assert_allclose(
            ours.line_covariance[2], scale[k : k + 3, k : k + 3], rtol=1e-4, atol=1e-12
        )


def test_a_drive_without_one_known_segment_follows_the_odometer(problem):
    problem, pose = problem
    with jax.enable_x64(True):
        blind = eqx.tree_at(lambda p: p.keyframes.known, problem, jnp.zeros((N, K), bool))
        found = solve(blind)
        assert bool(jnp.isfinite(found.unknowns.pose).all())
        np.testing.assert_allclose(found.unknowns.pose[:, :3], pose[:, :3] + 0, atol=1e-3)
