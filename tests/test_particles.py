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
    most_likely,
    pose_covariance,
    resample_observable,
    systematic,
)

KEYS = [jax.random.key(i) for i in range(20)]
TEETH = (0.3, 0.6)


def log(*weights):
    return jnp.log(jnp.array(weights, float) / sum(weights))


def cloud(xy, yaw, log_weight):
    N = len(yaw)
    bias = OdometerBias(jnp.arange(4.0 * N).reshape(N, 4), jnp.eye(4))
    return Particles(SE2(jnp.array(xy, float), jnp.array(yaw, float)), bias, log_weight)


def test_resampling_worked_by_hand():
    """Weights 1/2, 1/4, 1/4, offsets a quarter apart: twice, once, once, wherever they begin."""
    for key in KEYS:
        np.testing.assert_array_equal(
            systematic(jax.random.uniform(key), log(2, 1, 1, 1e-30)), [0, 0, 1, 2]
        )


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
        counts = np.bincount(
            systematic(jax.random.uniform(key), jnp.log(jnp.asarray(weights, float))), minlength=30
        )
        assert counts.sum() == 30
        assert (np.abs(counts - 30 * weights) < 1 + 1e-4).all()


def test_resampling_is_a_comb_on_the_cumulative_weights(rng):
    weights = rng.random(16)
    cumulative = np.cumsum(weights / weights.sum())
    for key in KEYS[:5]:
        offsets = (float(jax.random.uniform(key)) + np.arange(16)) / 16
        expected = [min(int(np.sum(cumulative < offset)), 15) for offset in offsets]
        np.testing.assert_array_equal(systematic(jax.random.uniform(key), log(*weights)), expected)


def test_the_scale_of_the_weights_does_not_matter():
    for key in KEYS[:5]:
        for shift in (-3.0, 0.0, 5.0):
            drawn = systematic(jax.random.uniform(key), log(1, 2, 3, 2) + shift)
            np.testing.assert_array_equal(
                drawn, systematic(jax.random.uniform(key), log(1, 2, 3, 2))
            )


def test_resampling_is_unbiased():
    weights = np.array([0.5, 0.3, 0.15, 0.05])
    offsets = jax.random.uniform(jax.random.key(0), (4000,))
    drawn = jax.vmap(systematic, (0, None))(offsets, log(*weights))
    share = np.bincount(np.asarray(drawn).ravel(), minlength=4) / drawn.size
    np.testing.assert_allclose(share, weights, atol=0.01)


def test_equal_weights_keep_every_particle():
    for N in (7, 1000):
        for key in KEYS[:5]:
            np.testing.assert_array_equal(
                systematic(jax.random.uniform(key), jnp.full(N, -jnp.log(N), float)), np.arange(N)
            )


def test_one_particle_with_everything_is_the_only_parent():
    for best in (0, 3, 7):
        for key in KEYS[:5]:
            drawn = systematic(jax.random.uniform(key), jnp.full(8, -jnp.inf).at[best].set(0.0))
            np.testing.assert_array_equal(drawn, best)


def test_the_winner_takes_all():
    np.testing.assert_array_equal(most_likely(log(1, 5, 3)), [1, 1, 1])
    np.testing.assert_array_equal(most_likely(log(1, 1)), [0, 0])


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


def corridor_cloud(rng, N, free=0.6, middle=(400.0, -300.0)):
    """Particles about a direction, whose curvatures go with their yaws; along, across, yaw."""
    along, across, yaw, scale = rng.normal(0, [0.3, 0.01, 0.004, 0.01], size=(N, 4)).T
    curvature = 0.5 * yaw + rng.normal(0, 0.001, N)
    c, s = np.cos(free), np.sin(free)
    xy = np.array(middle) + np.column_stack([c * along - s * across, s * along + c * across])
    b = np.column_stack([scale, np.zeros(N), np.zeros(N), curvature])
    T = SE2(jnp.asarray(xy), jnp.asarray(free + yaw))
    bias = OdometerBias(jnp.asarray(b), jnp.eye(4))
    return Particles(T, bias, jnp.full(N, -jnp.log(N), float)), (along, across, yaw)


def places(particles, free=0.6, middle=(400.0, -300.0)):
    d = np.asarray(particles.T_world_robot.xy) - middle
    c, s = np.cos(free), np.sin(free)
    return d @ [c, s], d @ [-s, c], np.asarray(particles.T_world_robot.yaw) - free


def test_what_was_not_seen_stays_each_particle_s_own(rng, x64):
    """However often is drawn: the places along the way and the scales are those that they were."""
    particles, (along, *_) = corridor_cloud(rng, 500)
    for key in KEYS:
        _, across, yaw = places(particles)
        log_likelihood = jnp.asarray(-0.5 * ((across - 0.002) / 0.01) ** 2)
        drawn = resample_observable(
            jax.random.uniform(key, (2,)),
            particles,
            particles.T_world_robot,
            log_likelihood,
            jnp.array(0.6),
        )
        np.testing.assert_allclose(places(drawn)[0], along, atol=1e-9)
        np.testing.assert_array_equal(drawn.bias.mean[:, 0], particles.bias.mean[:, 0])
        pairs = set(zip(across.round(9), yaw.round(9), strict=True))
        assert set(zip(*(a.round(9) for a in places(drawn)[1:]), strict=True)) <= pairs
        particles = drawn
    assert np.std(places(particles)[1]) < 0.005  # while that of what was seen has narrowed


def test_what_was_seen_is_drawn_by_its_likelihood_and_teaches_the_errors_in_turning(rng, x64):
    """Gauss: the yaw's posterior is that of Bayes, and the curvature follows as Kalman's would."""
    particles, (_, _, yaw) = corridor_cloud(rng, 20_000)
    log_likelihood = jnp.asarray(-0.5 * ((yaw - 0.003) / 0.003) ** 2)
    drawn = resample_observable(
        jnp.array(TEETH), particles, particles.T_world_robot, log_likelihood, jnp.array(0.6)
    )
    gain = 0.004**2 / (0.004**2 + 0.003**2)
    _, _, found = places(drawn)
    assert found.mean() == pytest.approx(0.003 * gain, rel=0.03)
    assert found.std() == pytest.approx(0.004 * np.sqrt(1 - gain), rel=0.03)
    learned = np.asarray(drawn.bias.mean[:, 3])
    assert learned.mean() == pytest.approx(0.5 * 0.003 * gain, rel=0.05)
    expected = np.sqrt(0.001**2 + 0.5**2 * 0.004**2 * (1 - gain))
    assert learned.std() == pytest.approx(expected, rel=0.03)
    assert np.corrcoef(learned, found)[0, 1] > 0.6


def test_of_what_was_tried_only_what_was_seen_is_taken(rng, x64):
    particles, (along, across, yaw) = corridor_cloud(rng, 200)
    T = particles.T_world_robot
    tried = SE2(T.xy.at[7].add(5.0), T.yaw.at[7].add(0.2))  # one slipped, and alone is right
    log_likelihood = jnp.full(200, -1000.0).at[7].set(0)
    drawn = resample_observable(jnp.array(TEETH), particles, tried, log_likelihood, jnp.array(0.6))
    c, s = np.cos(0.6), np.sin(0.6)
    np.testing.assert_allclose(places(drawn)[0], along, atol=1e-9)
    np.testing.assert_allclose(places(drawn)[1], across[7] + 5 * (c - s), atol=1e-9)
    np.testing.assert_allclose(places(drawn)[2], yaw[7] + 0.2, atol=1e-9)


def test_weights_from_before_are_those_of_whole_particles(rng, x64):
    particles, (along, across, *_) = corridor_cloud(rng, 100)
    weights = jnp.where(jnp.arange(100) < 25, jnp.log(0.04), -1e3)
    particles = Particles(particles.T_world_robot, particles.bias, weights)
    drawn = resample_observable(
        jnp.array(TEETH), particles, particles.T_world_robot, jnp.zeros(100), jnp.array(0.6)
    )
    np.testing.assert_allclose(np.unique(places(drawn)[0].round(9)), np.sort(along[:25].round(9)))
    np.testing.assert_allclose(np.unique(places(drawn)[1].round(9)), np.sort(across[:25].round(9)))
    np.testing.assert_allclose(jnp.exp(drawn.log_weight), 0.01)


def test_a_cloud_in_one_point_stays_there(x64):
    particles = cloud(np.tile([3.0, 4.0], (8, 1)), np.full(8, 0.1), jnp.full(8, -jnp.log(8)))
    drawn = resample_observable(
        jnp.array(TEETH), particles, particles.T_world_robot, jnp.zeros(8), jnp.array(0.1)
    )
    np.testing.assert_allclose(drawn.T_world_robot.xy, particles.T_world_robot.xy)
    np.testing.assert_allclose(drawn.bias.mean, particles.bias.mean)
