"""The smoother's elimination against dense algebra, and its solution against a known world."""

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
from sofjax.smoothing.problem import odometer_residual
from sofjax.smoothing.sparse.blocks import Jacobian
from sofjax.smoothing.sparse.dissection import dissect, divide
from sofjax.smoothing.sparse.elimination import eliminate
from sofjax.smoothing.sparse.marginals import marginals

pytestmark = pytest.mark.slow  # compiles in double precision, minutes on a busy machine

N, K = 6, 7
LEAVES = [0, 0, 0, 1, 1, 2]
CUT = lambda problem: dissect(problem.keyframes, K, np.array(LEAVES))


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
        off_floor = jnp.zeros(K, bool).at[2].set(True)
        problem = Problem(
            camera, mount, MotionModel(), Priors(), keyframes, anchor, off_floor, start
        )
        return problem, pose


def _dense(problem, unknowns):
    flat, restore = jax.flatten_util.ravel_pytree(unknowns)
    J = jax.jacfwd(lambda x: jax.flatten_util.ravel_pytree(residuals(restore(x), problem))[0])(flat)
    return np.asarray(J.T @ J)


def _dense_of(blocks, keyframes):
    """The whole matrix, block by block."""
    P, L = 5 * N, 3 * K
    A = np.zeros((P + L + 8, P + L + 8))
    for i in range(N):
        at = slice(5 * i, 5 * i + 5)
        A[at, at] = blocks.pose[i]
        A[at, P + L :] = blocks.pose_shared[i]
        if i + 1 < N:
            A[at, 5 * i + 5 : 5 * i + 10] = blocks.next[i]
        for m in np.flatnonzero(keyframes.known[i]):
            k = P + 3 * int(keyframes.line[i, m])
            A[at, k : k + 3] += blocks.seen[i, m]
    for k in range(K):
        at = slice(P + 3 * k, P + 3 * k + 3)
        A[at, at] = blocks.line[k]
        A[at, P + L :] = blocks.line_shared[k]
    A[P + L :, P + L :] = blocks.shared
    return np.triu(A) + np.triu(A, 1).T


def test_the_derivatives_of_all_residuals_are_central_differences(problem):
    problem, _ = problem
    with jax.enable_x64(True):
        flat, restore = jax.flatten_util.ravel_pytree(problem.start)
        f = lambda x: jax.flatten_util.ravel_pytree(residuals(restore(x), problem))[0]
        steps = 1e-5 * jnp.eye(len(flat))
        of_all = jax.jit(jax.vmap(f))
        central = lambda h: (of_all(flat + h * steps) - of_all(flat - h * steps)).T / (2e-5 * h)
        expected = (4 * central(0.5) - central(1.0)) / 3
        found = jax.jit(jax.jacfwd(f))(flat)
        scale = 1e-3 + jnp.abs(expected).max(axis=1, keepdims=True)  # of each residual
        np.testing.assert_allclose(found / scale, expected / scale, atol=1e-6)
        assert (jnp.abs(found) > 0).any(axis=0).all()  # each unknown is told by some


def test_what_the_odometer_did_not_tell_weighs_less(problem):
    problem, _ = problem
    with jax.enable_x64(True):
        before, after = jnp.zeros(5), jnp.zeros(5).at[0].set(0.5)
        miss = lambda unknown: odometer_residual(
            problem, before, after, jnp.zeros(8), SE2.identity(), jnp.zeros(3), unknown
        )[0]
        assert miss(None) == pytest.approx(500) and miss(jnp.zeros(3)) == pytest.approx(500)
        assert miss(jnp.full(3, 0.25)) == pytest.approx(1, abs=1e-5)


def test_assembled_blocks_are_those_of_the_dense_normal_equations(problem):
    problem, _ = problem
    with jax.enable_x64(True):
        u = problem.start
        _, jvp = jax.linearize(lambda v: residuals(v, problem), u)
        got = _dense_of(Jacobian.of(jvp, u).blocks(problem.keyframes, 0.25), problem.keyframes)
        dense = _dense(problem, u) + 0.25 * np.eye(5 * N + 3 * K + 8)
        scale = np.sqrt(np.outer(np.diag(dense), np.diag(dense)))
        np.testing.assert_allclose(got / scale, dense / scale, atol=1e-12)


def test_the_jacobian_transposed_is_the_gradient_of_half_the_squares(problem):
    problem, _ = problem
    with jax.enable_x64(True):
        half = lambda u: 0.5 * sum((r**2).sum() for r in jax.tree.leaves(residuals(u, problem)))
        want = jax.grad(half)(problem.start)
        r, jvp = jax.linearize(lambda v: residuals(v, problem), problem.start)
        got, measured = Jacobian.of(jvp, problem.start).transposed(problem.keyframes, r)
        for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())
        seen = lambda u: 0.5 * (residuals(u, problem).pixels ** 2).sum()
        want = jax.grad(seen)(problem.start).line
        np.testing.assert_allclose(measured, want, rtol=1e-9, atol=1e-9 * np.abs(want).max())


def test_keyframes_of_one_place_are_of_one_leaf_however_often_it_is_passed(rng):
    lap = np.stack([np.linspace(0, 60, 200), np.zeros(200)], axis=1)
    xy = np.concatenate([lap, lap[::-1], lap]) + rng.normal(0, 0.01, (600, 2))
    leaf = divide(xy)
    assert leaf.max() == 15
    assert np.bincount(leaf).max() <= 128
    for i in range(16):
        assert np.ptp(xy[leaf == i, 0]) < 60 / 16 + 0.5


def test_unknowns_are_eliminated_under_all_that_know_them(problem):
    problem, _ = problem
    frames = problem.keyframes
    known = jnp.zeros((N, K), bool).at[0, 1].set(True).at[1, 4].set(True).at[4, 4].set(True)
    frames = eqx.tree_at(lambda f: f.known, frames, known.at[5, 6].set(True))
    found = dissect(frames, K, np.array(LEAVES))
    low, root = found.generations
    unknown = lambda k: 5 * N + 3 * k
    assert unknown(1) in low.own[0]
    assert unknown(6) in low.own[2]
    assert unknown(4) in low.border[0]
    assert unknown(4) in low.border[1]
    assert unknown(4) in root.own[0]
    assert 5 * 2 in root.own[0]  # the last pose of the first leaf, known to the next
    assert 5 * 0 in low.own[0]
    each = np.concatenate([np.asarray(g.own).ravel() for g in found.generations])
    assert sorted(each[each < found.size]) == list(range(found.size))  # each of them once
    here = np.asarray(low.border[1])
    above = np.asarray(low.above[1])
    real = here < found.size
    np.testing.assert_array_equal(np.asarray(root.own[0])[above[real]], here[real])


@pytest.mark.parametrize(
    "leaves", [[0] * 6, LEAVES, [0, 1, 2, 3, 1, 0], [0, 0, 5, 6, 9, 15]], ids=str
)
def test_a_step_by_dissection_solves_the_dense_equations(problem, leaves):
    problem, _ = problem
    with jax.enable_x64(True):
        # the first lines are seen by all, the next by the first half, the last by the second
        known = problem.keyframes.known.at[3:, 3:5].set(False).at[:3, 5:].set(False)
        problem = eqx.tree_at(lambda p: p.keyframes.known, problem, known)
        u = problem.start
        _, jvp = jax.linearize(lambda v: residuals(v, problem), u)
        blocks = Jacobian.of(jvp, u).blocks(problem.keyframes, 1.0)
        dissection = dissect(problem.keyframes, K, np.array(leaves))
        factors = jax.jit(eliminate)(blocks, dissection)
        rng = np.random.default_rng(1)
        right = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)), u)
        got, _ = jax.flatten_util.ravel_pytree(factors.solve(right))
        dense = _dense(problem, u) + np.eye(5 * N + 3 * K + 8)
        want = np.linalg.solve(dense, jax.flatten_util.ravel_pytree(right)[0])
        np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-9 * np.abs(want).max())

        inverse = np.linalg.inv(dense)
        found = jax.jit(marginals)(factors)
        P = 5 * N
        for i in range(N):
            at = slice(5 * i, 5 * i + 5)
            np.testing.assert_allclose(found.pose[i], inverse[at, at], rtol=1e-6, atol=1e-12)
        some = rng.permutation(np.append(np.arange(K), 0))  # in any order, and one twice
        want = inverse[P : P + 3 * K, P : P + 3 * K].reshape(K, 3, K, 3)[some][:, :, some]
        np.testing.assert_allclose(found.of_lines(some), want, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(found.shared, inverse[-8:, -8:], rtol=1e-6, atol=1e-12)


def test_solution_is_that_of_a_dense_solver_and_finds_the_path(problem):
    problem, pose = problem
    with jax.enable_x64(True):
        ours = solve(problem, CUT(problem))
        assert bool(ours.converged)
        np.testing.assert_allclose(ours.unknowns.pose[:, :3], pose[:, :3], atol=5e-3)
        solver = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)
        dense = optx.least_squares(residuals, solver, problem.start, problem, max_steps=100)
        np.testing.assert_allclose(ours.unknowns.pose, dense.value.pose, atol=2e-5)
        np.testing.assert_allclose(ours.unknowns.line, dense.value.line, atol=2e-4)


def test_marginal_covariances_are_those_of_the_dense_inverse(problem):
    problem, _ = problem
    with jax.enable_x64(True):
        ours = solve(problem, CUT(problem))
        scale = np.linalg.inv(_dense(problem, ours.unknowns))
        for i in range(N):
            want = scale[5 * i : 5 * i + 5, 5 * i : 5 * i + 5]
            np.testing.assert_allclose(ours.pose_covariance[i], want, rtol=1e-4, atol=1e-12)
        k = 5 * N + 3 * 2
        third = ours.marginals.of_lines(jnp.array([2]))[0, :, 0]
        np.testing.assert_allclose(third, scale[k : k + 3, k : k + 3], rtol=1e-4, atol=1e-12)


def test_a_drive_without_one_known_segment_follows_the_odometer(problem):
    problem, pose = problem
    with jax.enable_x64(True):
        blind = eqx.tree_at(lambda p: p.keyframes.known, problem, jnp.zeros((N, K), bool))
        found = solve(blind, CUT(blind))
        assert bool(jnp.isfinite(found.unknowns.pose).all())
        np.testing.assert_allclose(found.unknowns.pose[:, :3], pose[:, :3] + 0, atol=1e-3)
