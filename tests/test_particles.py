"""Particles: weights, effective size, and how the next generation is drawn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sofjax.geometry import SE2
from sofjax.motion import OdometerBias
from sofjax.particles import (
    Particles,
    effective_size,
    mean_pose,
    pose_covariance,
    systematic,
    winner,
)

KEYS = [jax.random.key(i) for i in range(20)]


def log(*weights):
    return jnp.log(jnp.array(weights, float) / sum(weights))


def cloud(xy, yaw, log_weight):
    N = len(yaw)
    bias = OdometerBias(jnp.arange(4.0 * N).reshape(N, 4), jnp.eye(4))
    return Particles(SE2(jnp.array(xy, float), jnp.array(yaw, float)), bias, log_weight)


def test_resampling_worked_by_hand():
    """Weights 1/2, 1/4, 1/4, teeth a quarter apart: twice, once, once, wherever they begin."""
    for key in KEYS:
        np.testing.assert_array_equal(systematic(key, log(2, 1, 1, 1e-30)), [0, 0, 1, 2])


def test_effective_size_worked_by_hand():
    assert effective_size(log(1, 1, 1, 1)) == pytest.approx(4)
    assert effective_size(log(1, 1, 0, 0)) == pytest.approx(2)
    assert effective_size(log(0, 1, 0, 0)) == pytest.approx(1)
    assert effective_size(log(3, 1)) == pytest.approx(1 / (0.75**2 + 0.25**2))


def test_effective_size_lies_between_one_and_N(rng):
    for scale in (0, 1, 10, 1000):
        size = effective_size(jax.nn.log_softmax(jnp.asarray(rng.normal(size=50) * scale, float)))
        assert 1 - 1e-4 <= size <= 50 + 1e-3


def test_each_particle_is_drawn_as_often_as_its_weight_says_up_to_one(rng):
    weights = rng.random(30) ** 4
    weights = weights / weights.sum()
    for key in KEYS:
        counts = np.bincount(systematic(key, jnp.log(jnp.asarray(weights, float))), minlength=30)
        assert counts.sum() == 30
        assert (np.abs(counts - 30 * weights) < 1 + 1e-4).all()


def test_resampling_is_a_comb_on_the_cumulative_weights(rng):
    weights = rng.random(16)
    cumulative = np.cumsum(weights / weights.sum())
    for key in KEYS[:5]:
        teeth = (float(jax.random.uniform(key)) + np.arange(16)) / 16
        expected = [min(int(np.sum(cumulative < tooth)), 15) for tooth in teeth]
        np.testing.assert_array_equal(systematic(key, log(*weights)), expected)


def test_the_scale_of_the_weights_does_not_matter():
    for key in KEYS[:5]:
        for shift in (-3.0, 0.0, 5.0):
            drawn = systematic(key, log(1, 2, 3, 2) + shift)
            np.testing.assert_array_equal(drawn, systematic(key, log(1, 2, 3, 2)))


def test_resampling_is_unbiased():
    weights = np.array([0.5, 0.3, 0.15, 0.05])
    drawn = jax.vmap(systematic, (0, None))(
        jax.random.split(jax.random.key(0), 4000), log(*weights)
    )
    share = np.bincount(np.asarray(drawn).ravel(), minlength=4) / drawn.size
    np.testing.assert_allclose(share, weights, atol=0.01)


def test_equal_weights_keep_every_particle():
    for N in (7, 1000):
        for key in KEYS[:5]:
            np.testing.assert_array_equal(
                systematic(key, jnp.full(N, -jnp.log(N), float)), np.arange(N)
            )


def test_one_particle_with_everything_is_the_only_parent():
    for best in (0, 3, 7):
        for key in KEYS[:5]:
            drawn = systematic(key, jnp.full(8, -jnp.inf).at[best].set(0.0))
            np.testing.assert_array_equal(drawn, best)


def test_the_winner_takes_all():
    np.testing.assert_array_equal(winner(log(1, 5, 3)), [1, 1, 1])
    np.testing.assert_array_equal(winner(log(1, 1)), [0, 0])


def test_the_chosen_have_equal_weights_and_keep_their_pose_and_bias():
    particles = cloud([[0, 0], [1, 1], [2, 2]], [0.0, 0.1, 0.2], log(1, 5, 3))
    chosen = particles.take(jnp.array([2, 0, 2]))
    np.testing.assert_allclose(chosen.T_world_robot.xy, [[2, 2], [0, 0], [2, 2]])
    np.testing.assert_allclose(chosen.T_world_robot.yaw, [0.2, 0, 0.2])
    np.testing.assert_allclose(chosen.bias.mean, particles.bias.mean[jnp.array([2, 0, 2])])
    np.testing.assert_allclose(jnp.exp(chosen.log_weight), 1 / 3, rtol=1e-6)


def test_the_mean_pose_worked_by_hand():
    mean = mean_pose(cloud([[0, 0], [4, 8]], [0.0, 0.4], log(3, 1)))
    np.testing.assert_allclose([*mean.xy, mean.yaw], [1, 2, 0.1], rtol=1e-6)


def test_the_mean_yaw_keeps_the_turns_of_the_path():
    """Yaws are not wrapped along a path, so that a cloud about half a turn has its mean there."""
    mean = mean_pose(cloud([[0, 0], [0, 0]], [np.pi - 0.1, np.pi + 0.1], log(1, 1)))
    assert mean.yaw == pytest.approx(np.pi)
    assert mean_pose(cloud([[0, 0]], [9 * np.pi], log(1))).yaw == pytest.approx(9 * np.pi)


def test_the_covariance_is_that_of_numpy(rng):
    xy, yaw, weights = rng.normal(size=(9, 2)), rng.normal(size=9), rng.uniform(0.1, 1, size=9)
    expected = np.cov(np.column_stack([xy, yaw]).T, aweights=weights, bias=True)
    found = pose_covariance(cloud(xy, jnp.array(yaw), log(*weights)))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert not pose_covariance(cloud([[3, 4]], [0.1], log(1))).any()
