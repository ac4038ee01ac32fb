"""Derivatives of the batch likelihood: finite where it is degenerate, right elsewhere."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import jit_quickly
from test_batch import (
    NOISE,
    NOISY,
    SIZES,
    K,
    M,
    assert_close,
    covariances,
    image_problem,
    make_camera,
    problem,
    reference,
    scratch,
)

from sofjax.geometry import SE2, Segments
from sofjax.likelihood import LineNoise
from sofjax.likelihood.batch import (
    culling,
    image_log_likelihood,
    log_likelihood,
)


@pytest.fixture
def short_programs(monkeypatch, x64):
    """Groups of two pairs, so that compiling does not take longer than all else; in float64."""
    monkeypatch.setattr(culling, "_group_size", lambda K, prune: 2)


def degenerate(name, N):
    particles, observed, segment_map = problem(N, seed=3)
    map_ends, seen_ends = segment_map.endpoints, observed.endpoints
    if name == "rho 0":  # lines through the robot itself
        seen_ends = seen_ends.at[:4, 1].set(-0.5 * seen_ends[:4, 0])
        map_ends = map_ends.at[:4, 1].set(-map_ends[:4, 0])
        particles = SE2(particles.xy.at[: N // 2].set(0.0), particles.yaw)
    elif name == "parallel and identical":
        wall = jnp.array([[-1.0, 1.0], [2.0, 1.0]])
        map_ends = map_ends.at[:20].set(wall).at[5:10, :, 1].add(0.2)
        seen_ends = seen_ends.at[:4].set(wall)
        particles = SE2(jnp.zeros((N, 2)), jnp.zeros(N))
    elif name == "zero length":
        map_ends = map_ends.at[::3, 1].set(map_ends[::3, 0])
        seen_ends = seen_ends.at[::2, 1].set(seen_ends[::2, 0]).at[0].set(0.0)
    elif name == "all masked":
        observed = Segments(seen_ends, jnp.zeros(M, bool))
    elif name == "empty map":
        segment_map = Segments(map_ends, jnp.zeros(K, bool))
    elif name == "500 m away":
        particles, observed, segment_map = problem(N, seed=3, at=(500.0, -300.0, 2.0))
        return particles, observed, segment_map
    return particles, Segments(seen_ends, observed.valid), Segments(map_ends, segment_map.valid)


DEGENERATE = [
    "rho 0", "parallel and identical", "zero length", "all masked", "empty map", "500 m away"
]  # fmt: skip


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_inputs(name, soft):
    for N in SIZES.values():
        given = degenerate(name, N)
        got = log_likelihood(*given, NOISY, soft=soft)
        assert_close(got, reference(*given, *NOISE, soft=soft))


@pytest.mark.parametrize("name", DEGENERATE)
def test_derivatives_are_finite_at_degenerate_inputs(name):
    for N in SIZES.values():
        particles, observed, segment_map = degenerate(name, N)
        noise = tuple(map(jnp.asarray, NOISE))
        at = (particles, observed.endpoints, segment_map.endpoints, noise)
        for leaf in jax.tree.leaves(gradients(at, observed.valid, segment_map.valid)):
            assert np.isfinite(leaf).all()


@jit_quickly
def gradients(at, seen_valid, map_valid):
    """By all that varies, and how they change along one direction."""

    def total(at):
        particles, seen, ends, noise = at
        given = particles, Segments(seen, seen_valid), Segments(ends, map_valid)
        return log_likelihood(*given, LineNoise(*noise), soft=True).sum()

    return jax.jvp(jax.grad(total), (at,), (jax.tree.map(jnp.ones_like, at),))


STEP = 1e-6  # of the differences


def assert_derivatives(total, at):
    """Both ways of `total`, of each part of the dict `at`, are its difference quotient."""

    @jit_quickly
    def every_way(at, direction):
        value, forward = jax.jvp(total, (at,), (direction,))
        return value, jax.grad(total)(at), forward

    r = np.random.default_rng(4)
    none = jax.tree.map(jnp.zeros_like, at)
    for part in at:
        random = jax.tree.map(lambda leaf: jnp.asarray(r.normal(size=leaf.shape)), at[part])
        direction = none | {part: random}
        move = lambda step, d=direction: jax.tree.map(lambda a, b: a + step * b, at, d)
        ahead, gradient, forward = every_way(move(STEP), direction)
        behind, gradient_behind, forward_behind = every_way(move(-STEP), direction)
        difference = (ahead - behind) / (2 * STEP)
        middle = jax.tree.map(lambda a, b: (a + b) / 2, gradient, gradient_behind)
        dots = jax.tree.map(lambda g, d: jnp.sum(g * d), middle, direction)
        backward = sum(jax.tree.leaves(dots))
        assert_close(backward / difference, 1, 1e-5)
        assert_close((forward + forward_behind) / 2 / difference, 1, 1e-5)


@pytest.mark.usefixtures("short_programs")
def test_gradient_by_everything_is_the_difference_quotient():
    """Poses, observed segments, map, sigmas, e_max and covariances, both ways."""
    particles, observed, segment_map = problem(100)
    at = {
        "particles": particles, "seen": observed.endpoints, "map": segment_map.endpoints,
        "noise": (jnp.asarray(0.15), jnp.asarray(0.08), jnp.asarray(9.0)),
        "covariance": covariances(M),
    }  # fmt: skip

    def total(at):
        return log_likelihood(
            at["particles"], Segments(at["seen"], observed.valid),
            Segments(at["map"], segment_map.valid), LineNoise(*at["noise"]),
            soft=True, covariance=at["covariance"],
        ).sum()  # fmt: skip

    assert_derivatives(total, at)


@pytest.mark.usefixtures("short_programs")
def test_second_derivatives_of_a_whole_cloud():
    """Forwards over backwards: of the gradient by the pose, by poses, map and sigma."""
    particles, observed, segment_map = problem(100)

    def by_pose(at):
        def total(particles):
            moved = Segments(at["map"], segment_map.valid)
            noise = at["sigma"], 0.08, 9.0
            return log_likelihood(particles, observed, moved, LineNoise(*noise), soft=True).sum()

        gradient = jax.grad(total)(at["particles"])
        return gradient.xy.sum() + gradient.yaw.sum()

    at = {"particles": particles, "map": segment_map.endpoints, "sigma": jnp.asarray(0.15)}
    both = jit_quickly(lambda at, d: (by_pose(at), jax.jvp(by_pose, (at,), (d,))[1]))
    r = np.random.default_rng(5)
    direction = jax.tree.map(lambda leaf: jnp.asarray(r.normal(size=leaf.shape)), at)
    move = lambda step: jax.tree.map(lambda a, d: a + step * d, at, direction)
    (ahead, _), (behind, _) = both(move(STEP), direction), both(move(-STEP), direction)
    assert_close(both(at, direction)[1] / ((ahead - behind) / (2 * STEP)), 1, 1e-5)


@pytest.mark.usefixtures("x64")
def test_hessian_of_a_pose_gives_its_laplace_covariance():
    particles, observed, segment_map = problem(1, spread=(0.0, 0.0, 0.0))
    at = jnp.append(particles.xy[0], particles.yaw[0])

    def cost(pose):
        one = SE2(pose[None, :2], pose[2:])
        return -log_likelihood(one, observed, segment_map, NOISY, soft=True)[0]

    gradient, hessian = jit_quickly(jax.grad(cost)), jit_quickly(jax.hessian(cost))
    for _ in range(20):
        at = at - jnp.linalg.solve(hessian(at), gradient(at))
    assert float(jnp.linalg.norm(gradient(at))) < 1e-8
    information = hessian(at)
    covariance = jnp.linalg.inv(information)
    assert_close(information, information.T, 1e-9)
    assert (jnp.linalg.eigvalsh(covariance) > 0).all()
    step = 1e-5 * jnp.eye(3)
    differences = [(gradient(at + s) - gradient(at - s)) / 2e-5 for s in step]
    assert_close(information, jnp.stack(differences), 1e-5)


def test_gradient_at_full_size_under_jit():
    """10,000 x 30 x 100 in float32: backwards, forwards and a float64 difference quotient."""
    particles, observed, segment_map = problem(10_000, 30, 100, seed=6)
    total = lambda P: log_likelihood(P, observed, segment_map, NOISY, soft=True)
    backward = jax.jit(jax.grad(lambda P: total(P).sum()))(particles)

    @jax.jit
    def forward(particles, d_xy, d_yaw):
        return jax.jvp(total, (particles,), (SE2(d_xy, d_yaw),))[1]

    one, none = jnp.ones(10_000), jnp.zeros(10_000)
    along = [
        forward(particles, jnp.stack(xy, -1), yaw)
        for xy, yaw in [((one, none), none), ((none, one), none), ((none, none), one)]
    ]
    stacked = jnp.concatenate([backward.xy, backward.yaw[:, None]], axis=1)
    scale = jnp.abs(stacked).max()
    assert_close(jnp.stack(along, axis=1) / scale, stacked / scale, 1e-5)

    some = slice(0, 10_000, 400)
    poses = np.concatenate([particles.xy[some], particles.yaw[some, None]], axis=1, dtype=float)
    h = 1e-5

    def value(poses):
        at = eqx.tree_at(lambda P: (P.xy, P.yaw), particles, (poses[:, :2], poses[:, 2]))
        return reference(at, observed, segment_map, *NOISE, soft=True)

    differences = [(value(poses + d) - value(poses - d)) / (2 * h) for d in h * np.eye(3)]
    assert_close(stacked[some] / scale, np.stack(differences, axis=1) / scale, 1e-4)


def test_nor_for_a_gradient():
    assert scratch((10_000, 30, 400), soft=True) < 0.1 * 4 * 10_000 * 30 * 400


@pytest.mark.usefixtures("short_programs")
def test_gradient_by_the_mount_is_the_difference_quotient():
    mount, particles, image, segment_map = image_problem(60)

    def total(at):
        given = particles, image, segment_map
        return image_log_likelihood(make_camera(), at["mount"], *given, NOISY, soft=True).sum()

    assert_derivatives(total, {"mount": mount})
