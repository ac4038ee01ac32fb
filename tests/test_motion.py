"""The motion model: Gaussian about the odometer's reading, whose systematic errors are learned."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import jit_quickly

from sofjax.geometry import SE2
from sofjax.motion import (
    ONE_IN,
    MotionModel,
    OdometerBias,
    prior_bias,
    sample_motion,
    sample_slip,
)

pytestmark = pytest.mark.usefixtures("x64")

UNBIASED = MotionModel(distance_scale_sigma=0.0, turn_scale_sigma=0.0, curvature_sigma=0.0)
LOUD = MotionModel(distance_noise=0.03, lateral_noise=0.01, heading_noise=0.02, turn_noise=0.05)
N = 20_000
sample = jit_quickly(sample_motion)


def reading(*twist):
    return SE2.exp(jnp.array(twist, float))


def draws(model, odometer, mean=None):
    """Twists (forward, sideways, turn) of N particles, and what each has learned."""
    bias = prior_bias(model)
    means = jnp.broadcast_to(bias.mean if mean is None else jnp.array(mean, float), (N, 4))
    motion, learned, _ = sample(
        model,
        OdometerBias(means, bias.covariance),
        odometer,
        jax.random.key(1),
    )
    return np.asarray(motion.log()), learned


def assert_normal(sample, mean, sigma):
    """Mean and standard deviation within five standard errors."""
    assert abs(sample.mean() - mean) < 5 * sigma / np.sqrt(len(sample)) + 1e-12
    assert abs(sample.std() - sigma) < 5 * sigma / np.sqrt(2 * len(sample)) + 1e-12


def test_a_robot_that_stands_still_stays_where_it_is():
    motion, learned = draws(LOUD, SE2.identity())
    np.testing.assert_array_equal(motion, 0)
    np.testing.assert_array_equal(learned.mean, 0)
    np.testing.assert_array_equal(learned.covariance, prior_bias(LOUD).covariance)


def test_a_robot_without_errors_goes_where_its_odometer_says():
    silent = MotionModel(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for twist in ((0.1, 0.0, 0.02), (-0.1, 0.01, -0.3), (0.0, 0.0, 0.5)):
        np.testing.assert_allclose(draws(silent, reading(*twist))[0], [twist] * N, atol=1e-12)


def test_a_straight_metre_worked_by_hand():
    """sigma = noise per sqrt(metre), and lateral slip; half of a turn's error bends the way."""
    model = MotionModel(0.03, 0.01, 0.02, 0.05, 0.0, 0.0, 0.0)
    forward, sideways, turn = draws(model, reading(1.0, 0.0, 0.0))[0].T
    assert_normal(forward, 1, 0.03)
    assert_normal(sideways, 0, 0.01)
    assert_normal(turn, 0, 0.02)
    assert abs(np.corrcoef(forward, turn)[0, 1]) < 5 / np.sqrt(N)


@pytest.mark.parametrize("sign", [1, -1])
def test_noise_grows_with_the_root_of_the_way_and_of_the_turn(sign):
    forward, sideways, turn = draws(
        MotionModel(0.03, 0.01, 0.02, 0.05, 0.0, 0.0, 0.0), reading(sign * 0.25, 0.0, sign * 0.36)
    )[0].T
    assert_normal(forward, sign * 0.25, 0.03 * 0.5)
    assert_normal(sideways, 0, 0.01 * 0.5)
    assert_normal(turn, sign * 0.36, np.hypot(0.02 * 0.5, 0.05 * 0.6))


def test_the_draw_has_the_spread_of_noise_and_systematic_errors_together():
    u, w = 0.5, 0.4
    forward, _, turn = draws(LOUD, reading(u, 0.0, w))[0].T
    scale, turn_scale, curvature = (
        LOUD.distance_scale_sigma, LOUD.turn_scale_sigma, LOUD.curvature_sigma,
    )  # fmt: skip
    wander = 1 + LOUD.bias_drift**2 * u  # variance of the priors after the way driven
    assert_normal(forward, u, np.sqrt(0.03**2 * u + (scale * u) ** 2 * wander))
    noise = 0.02**2 * u + 0.05**2 * w
    systematic = ((turn_scale * w) ** 2 + (curvature * u) ** 2) * wander
    assert_normal(turn, w, np.sqrt(noise + systematic))


def test_known_systematic_errors_move_the_mean():
    forward, _, turn = draws(UNBIASED, reading(2.0, 0.0, 0.5), mean=[0.1, 0.2, 9.0, 0.01])[0].T
    assert abs(forward.mean() - 2.2) < 1e-3
    assert abs(turn.mean() - (0.5 + 0.2 * 0.5 + 0.01 * 2)) < 1e-3
    _, _, turn = draws(UNBIASED, reading(2.0, 0.0, -0.5), mean=[0.1, 9.0, 0.2, 0.01])[0].T
    assert abs(turn.mean() - (-0.5 - 0.2 * 0.5 + 0.01 * 2)) < 1e-3


def test_what_was_learned_is_the_bayesian_regression_on_the_draws():
    """z - u = A b + noise with a Gaussian prior of b, all rows at once."""
    model = MotionModel(0.03, 0.0, 0.02, 0.05, 0.1, 0.2, 0.05, bias_drift=0.0)
    rng, belief = (
        np.random.default_rng(3),
        prior_bias(MotionModel(0.03, 0.0, 0.02, 0.05, 0.1, 0.2, 0.05)),
    )
    information = np.linalg.inv(np.asarray(belief.covariance))
    weighted = np.zeros(4)
    for i in range(40):
        forward, turn = rng.uniform(-0.1, 0.5), rng.uniform(-0.5, 0.5)
        motion, belief, _ = sample(model, belief, reading(forward, 0.0, turn), jax.random.key(i))
        moved, _, turned = np.asarray(motion.log())
        A = np.array([[forward, 0, 0, 0], [0, max(turn, 0), min(turn, 0), abs(forward)]])
        W = np.diag(1 / np.array([
            0.03**2 * abs(forward), 0.02**2 * abs(forward) + 0.05**2 * abs(turn),
        ]))  # fmt: skip
        information = information + A.T @ W @ A
        weighted = weighted + A.T @ W @ [moved - forward, turned - turn]
    np.testing.assert_allclose(belief.covariance, np.linalg.inv(information), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(belief.mean, np.linalg.solve(information, weighted), rtol=1e-6)
    assert np.linalg.norm(belief.mean) > 0.01


def test_a_prior_of_zero_switches_an_error_off():
    _, learned = draws(UNBIASED, reading(0.5, 0.0, 0.3))
    np.testing.assert_array_equal(learned.mean, 0)
    np.testing.assert_array_equal(learned.covariance, 0)


def test_a_left_turn_teaches_nothing_about_right_turns_nor_a_turn_about_distance():
    _, learned = draws(LOUD, reading(0.0, 0.0, 0.4))
    assert (learned.mean[:, 1] != 0).all()
    np.testing.assert_array_equal(learned.mean[:, jnp.array([0, 2, 3])], 0)
    _, learned = draws(LOUD, reading(0.0, 0.0, -0.4))
    assert (learned.mean[:, 2] != 0).all()
    np.testing.assert_array_equal(learned.mean[:, jnp.array([0, 1, 3])], 0)


def test_systematic_errors_wander_with_the_way():
    """A belief far below its prior grows again by its drift, when the noise teaches nothing."""
    model = MotionModel(1e6, 0.0, 1e6, 1e6, 0.02, 0.05, 0.005, bias_drift=0.5)
    _, learned, _ = sample(
        model,
        OdometerBias(jnp.zeros(4), jnp.zeros((4, 4))),
        reading(2.0, 0.0, 0.1),
        jax.random.key(0),
    )
    sigma = np.array([0.02, 0.05, 0.05, 0.005]) * 0.5 * np.sqrt(2.0)
    np.testing.assert_allclose(learned.covariance, np.diag(sigma**2), rtol=1e-6, atol=1e-12)


def test_all_particles_share_one_covariance_whatever_they_drew():
    bias = prior_bias(LOUD)
    learned = [sample(LOUD, bias, reading(0.5, 0.0, 0.3), jax.random.key(i))[1] for i in range(3)]
    for other in learned[1:]:
        np.testing.assert_array_equal(other.covariance, learned[0].covariance)
        assert (other.mean != learned[0].mean).any()


def test_many_particles_are_each_drawn_from_their_own_belief():
    """All means alike but one: with the same key only that particle's motion differs."""
    bias = prior_bias(LOUD)
    odometer, key = reading(0.5, 0.0, 0.3), jax.random.key(5)
    alike = jnp.zeros((4, 4))
    of = lambda means: sample(LOUD, OdometerBias(means, bias.covariance), odometer, key)
    (motion, learned, _), (other, other_learned, _) = of(alike), of(alike.at[2].set(0.01))
    same = np.array([True, True, False, True])
    np.testing.assert_array_equal((motion.yaw == other.yaw), same)
    np.testing.assert_array_equal((motion.xy == other.xy).all(axis=1), same)
    np.testing.assert_allclose(
        other_learned.mean - learned.mean, np.where(same, 0, 0.01)[:, None] * np.ones(4)
    )
    assert len(np.unique(motion.yaw)) == 4


def slips(model, odometer, testable=True):
    """Twists of N particles, and their importance weights."""
    slip, log_weight = jax.jit(sample_slip, static_argnums=4)(
        model, odometer, jnp.array(testable), jax.random.key(2), N
    )
    return np.asarray(slip.log()), np.exp(np.asarray(log_weight))


def test_slips_are_tried_often_and_weigh_as_rarely_as_they_happen():
    model = MotionModel(slip_rate=0.05, slip_distance=0.02, slip_turn=0.1)
    twist, weight = slips(model, reading(0.4, 0, 0.1))
    slipped = twist[:, 2] != 0
    assert slipped.mean() == 1 / ONE_IN
    assert weight.mean() == pytest.approx(1)
    assert (weight * slipped).mean() == pytest.approx(0.05 * 0.4, rel=0.2)
    assert twist[slipped, 0].std() == pytest.approx(0.02, rel=0.1)
    assert twist[slipped, 2].std() == pytest.approx(0.1, rel=0.1)
    assert (twist[~slipped] == 0).all()


def test_each_of_a_few_particles_tries_a_slip_as_often():
    keys = jax.random.split(jax.random.key(3), 20_000)
    of_key = lambda key: sample_slip(MotionModel(), reading(0.4, 0, 0), jnp.array(True), key, 27)
    slip, _ = jax.jit(jax.vmap(of_key))(keys)
    np.testing.assert_allclose((slip.yaw != 0).mean(axis=0), 1 / ONE_IN, atol=0.006)


@pytest.mark.parametrize(
    ("model", "odometer", "testable"),
    [
        (MotionModel(slip_rate=0.0), (0.4, 0, 0.1), True),
        (MotionModel(), (0.0, 0, 0), True),
        (MotionModel(), (0.4, 0, 0), False),
    ],
)
def test_nothing_slips(model, odometer, testable):
    twist, weight = slips(model, reading(*odometer), testable)
    assert (twist == 0).all()
    assert (weight == 1).all()
