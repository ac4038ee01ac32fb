"""One pose against the map; III.A."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from conftest import jit_quickly

from sofjax.geometry import SE2, PolarLine
from sofjax.likelihood.measurements import Measurements
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.likelihood.tracking import (
    Candidates,
    adapt_inflation,
    mahalanobis,
    nothing_seen,
    pixels_and_weight,
    precompute,
    score,
)

pytestmark = pytest.mark.usefixtures("x64")


@jit_quickly
def compare_pose(sensor, measurements, candidates, T_predicted_nadir, used):
    return score(sensor, precompute(measurements, candidates), T_predicted_nadir, used)


def pose(x, y, yaw):
    return SE2(jnp.array([x, y], float), jnp.array(yaw, float))


def random_problem(rng, M=6, C=4):
    """Measurements near one of their candidates each, candidates of every kind, and some masked."""
    roots = rng.normal(size=(2, M, C, 2, 2))
    W = np.einsum("...ij,...kj->...ik", roots[0], roots[0]) * 1000 + 100 * np.eye(2)
    lines = np.stack([rng.normal(size=(M, C)) * 2, rng.uniform(-7, 7, size=(M, C))], -1)
    apparent_scale = rng.uniform(0.8, 1.3, size=(M, C))
    near = lines[np.arange(M), rng.integers(C, size=M)] + rng.normal(0, 0.03, size=(M, 2))
    turns = rng.integers(-1, 2, size=M)  # named from either side
    near = np.stack([near[:, 0] * (-1.0) ** turns, near[:, 1] + turns * np.pi], 1)
    return near, lines, apparent_scale, W, rng.random((M, C)) < 0.8


def as_arrays(near, lines, apparent_scale, W, valid, by_jitter=None, sigma=0.0):
    M = len(near)
    by_jitter = np.zeros((M, 2, 2)) if by_jitter is None else by_jitter
    loose = np.linalg.inv(
        np.linalg.inv(W) + sigma**2 * (by_jitter @ np.swapaxes(by_jitter, 1, 2))[:, None]
    )
    measurements = Measurements(
        endpoints_nadir=jnp.zeros((M, 2, 2)),
        valid=jnp.ones(M, bool),
        line=PolarLine(jnp.asarray(near[:, 0]), jnp.asarray(near[:, 1])),
        covariance=jnp.broadcast_to(jnp.eye(2), (M, 2, 2)),
        by_jitter=jnp.asarray(by_jitter),
    )
    candidates = Candidates(
        PolarLine(jnp.asarray(lines[..., 0]), jnp.asarray(lines[..., 1])),
        jnp.asarray(apparent_scale),
        jnp.asarray(W),
        jnp.asarray(loose),
        jnp.asarray(valid),
    )
    return measurements, candidates


def as_lists(lines, apparent_scale, W, valid):
    return [
        [
            (*lines[m, k], apparent_scale[m, k], W[m, k])
            for k in range(len(apparent_scale[m]))
            if valid[m, k]
        ]
        for m in range(len(lines))
    ]


STIFF = SensorModel(tilt_sigma=0.0)


def test_a_likelihood_worked_by_hand():
    """One line 1 m to the left, seen 3 cm too far and 0.02 rad off; sigmas 2 cm and 0.01 rad."""
    W = np.broadcast_to(np.diag([1 / 0.02**2, 1 / 0.01**2]), (1, 1, 2, 2))
    arrays = as_arrays(
        np.array([[1.03, 0.02]]), np.array([[[1.0, 0.0]]]), np.ones((1, 1)), W, [[True]]
    )
    used = jnp.ones(1, bool)
    found = compare_pose(STIFF, *arrays, SE2.identity(), used)
    assert found.error[0] == pytest.approx(1.5**2 + 2**2)
    assert found.log_likelihood == pytest.approx(-(1.5**2 + 2**2) / 2)
    # 3 cm more to the right and turned to the right by 0.02 rad it is exactly as seen
    found = compare_pose(STIFF, *arrays, pose(0.4, -0.03, -0.02), used)
    assert found.log_likelihood == pytest.approx(0, abs=1e-12)


def test_the_likelihood_is_the_loop_over_all_pairs(rng):
    inliers = 0
    for _ in range(10):
        near, *rest = problem = random_problem(rng)
        used = rng.random(len(near)) < 0.8
        T = rng.normal(size=3) * 0.02
        found = compare_pose(STIFF, *as_arrays(*problem), pose(*T), jnp.asarray(used))
        own = [[] if not may else some for may, some in zip(used, as_lists(*rest), strict=True)]
        expected = reference.log_likelihood(near, [True] * len(near), own, STIFF.e_max, T)
        assert found.log_likelihood == pytest.approx(expected, rel=1e-9)
        np.testing.assert_array_equal(found.jitter, 0)
        inliers += int((found.error < STIFF.e_max).sum())
    assert inliers > 10


def test_the_jitter_is_the_one_that_costs_least(rng):
    """Against a search over all jitters, the associations given."""
    sensor = SensorModel(tilt_sigma=0.01)
    for _ in range(4):
        near, lines, apparent_scale, W, _ = random_problem(rng, C=1)
        J = rng.normal(size=(len(near), 2, 2))
        # the image was taken with a jitter; one segment shows something unknown
        jitter = rng.normal(size=2) * 0.01
        turns = np.round((near[:, 1] - lines[:, 0, 1]) / np.pi)
        near = np.stack([lines[:, 0, 0] * (-1.0) ** turns, lines[:, 0, 1] + np.pi * turns], 1)
        near = near + J @ jitter + rng.normal(0, 0.01, size=near.shape)
        near[0] += [5.0, 0.4]
        valid = np.ones(apparent_scale.shape, bool)
        arrays = as_arrays(near, lines, apparent_scale, W, valid, J, sensor.tilt_sigma)
        found = compare_pose(sensor, *arrays, SE2.identity(), jnp.ones(len(near), bool))
        assert found.error[0] == sensor.e_max

        def cost(tilt, near=near, lines=lines, W=W, J=J):
            total = tilt @ tilt / sensor.tilt_sigma**2 + sensor.e_max
            for m in range(1, len(near)):
                d = np.array(reference.polar_difference(near[m], lines[m, 0])) - J[m] @ tilt
                total += d @ W[m, 0] @ d
            return total

        best = reference.best_jitter(cost, sensor.tilt_sigma)
        np.testing.assert_allclose(found.jitter, best, atol=1e-6)
        assert (found.error[1:] < sensor.e_max).all()
        assert found.log_likelihood == pytest.approx(-cost(best) / 2, rel=1e-6)


def test_a_segment_that_matches_nothing_costs_e_max_once(rng):
    near, lines, apparent_scale, W, valid = random_problem(rng)
    everything = jnp.ones(len(near), bool)
    valid = np.ones_like(valid)
    before = compare_pose(
        STIFF, *as_arrays(near, lines, apparent_scale, W, valid), SE2.identity(), everything
    )
    assert before.error[0] < STIFF.e_max
    for far in (5.0, 5000.0):
        moved = np.array([near[0] + [far, 0.3], *near[1:]])
        after = compare_pose(
            STIFF, *as_arrays(moved, lines, apparent_scale, W, valid), SE2.identity(), everything
        )
        cost = 2 * float(before.log_likelihood - after.log_likelihood)
        assert cost == pytest.approx(STIFF.e_max - float(before.error[0]))
        assert after.error[0] == STIFF.e_max


def test_an_empty_map_costs_e_max_for_every_segment_wherever_the_robot_is(rng):
    near, lines, apparent_scale, W, valid = random_problem(rng)
    arrays = as_arrays(near, lines, apparent_scale, W, np.zeros_like(valid))
    for T in rng.normal(size=(3, 3)):
        found = compare_pose(STIFF, *arrays, pose(*T), jnp.ones(6, bool))
        assert found.log_likelihood == pytest.approx(-6 * STIFF.e_max / 2)


def test_what_is_not_valid_counts_nothing_and_what_may_not_match_costs_the_most(rng):
    near, lines, apparent_scale, W, valid = random_problem(rng)
    mask = np.array([True, False, True, True, False, True])
    expected = reference.log_likelihood(
        near[mask],
        mask[mask],
        as_lists(lines[mask], apparent_scale[mask], W[mask], valid[mask]),
        9.0,
        np.zeros(3),
    )
    measurements, candidates = as_arrays(near, lines, apparent_scale, W, valid)
    unused = compare_pose(STIFF, measurements, candidates, SE2.identity(), jnp.asarray(mask))
    padded = Measurements(
        measurements.endpoints_nadir,
        jnp.asarray(mask),
        measurements.line,
        measurements.covariance,
        measurements.by_jitter,
    )
    invalid = compare_pose(STIFF, padded, candidates, SE2.identity(), jnp.ones(6, bool))
    assert invalid.log_likelihood == pytest.approx(expected)
    assert unused.log_likelihood == pytest.approx(expected - 2 * 9.0 / 2)
    nothing = compare_pose(STIFF, measurements, candidates, SE2.identity(), jnp.zeros(6, bool))
    assert nothing.log_likelihood == pytest.approx(-6 * 9.0 / 2)


def test_where_nothing_lies_on_the_floor_the_answer_is_known_without_comparing(rng):
    measurements, candidates = as_arrays(*random_problem(rng))
    measurements = eqx.tree_at(lambda s: s.valid, measurements, jnp.zeros(6, bool))
    found = compare_pose(STIFF, measurements, candidates, pose(0.1, 0.2, 0.3), jnp.zeros(6, bool))
    known = nothing_seen(STIFF, precompute(measurements, candidates))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(known), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def test_the_choice_is_the_candidate_that_costs_least(rng):
    near, lines, apparent_scale, W, valid = random_problem(rng)
    valid = np.ones_like(valid)
    found = compare_pose(
        STIFF, *as_arrays(near, lines, apparent_scale, W, valid), SE2.identity(), jnp.ones(6, bool)
    )
    for m in range(6):
        errors = [
            np.array(d) @ W[m, k] @ d
            for k in range(4)
            for d in [reference.polar_difference(near[m], lines[m, k])]
        ]
        assert found.choice[m] == np.argmin(errors)


def test_an_off_floor_line_moves_by_its_magnification():
    """Driving 10 cm nearer to a line that seems 1.5 times as far brings its image 15 cm nearer."""
    W = np.broadcast_to(1e4 * np.eye(2), (1, 1, 2, 2))
    arrays = as_arrays(
        np.array([[2.85, 0.0]]), np.array([[[3.0, 0.0]]]), np.full((1, 1), 1.5), W, [[True]]
    )
    found = compare_pose(STIFF, *arrays, pose(0, 0.1, 0), jnp.ones(1, bool))
    assert found.log_likelihood == pytest.approx(0, abs=1e-12)


def test_the_true_pose_is_the_most_likely(rng):
    """Exact measurements of a few lines, from a place off the predicted one."""
    true = np.array([0.03, -0.02, 0.04])
    lines = np.array([[[1.0, 0.1]], [[-1.5, 0.0]], [[2.0, 1.5]], [[-0.4, 2.2]]])
    near = []
    for rho, theta in lines[:, 0]:
        near.append((rho - np.array([-np.sin(theta), np.cos(theta)]) @ true[:2], theta - true[2]))
    W = np.broadcast_to(1e3 * np.eye(2), (4, 1, 2, 2))
    arrays = as_arrays(np.array(near), lines, np.ones((4, 1)), W, np.ones((4, 1), bool))
    used = jnp.ones(4, bool)
    assert compare_pose(STIFF, *arrays, pose(*true), used).log_likelihood == pytest.approx(
        0, abs=1e-9
    )
    for off in rng.normal(size=(30, 3)) * 0.02:
        assert compare_pose(STIFF, *arrays, pose(*(true + off)), used).log_likelihood < -1e-4


def test_mahalanobis_is_the_matrix_product(rng):
    d, root = rng.normal(size=(5, 3, 2)), rng.normal(size=(5, 3, 2, 2))
    W = root @ np.swapaxes(root, -1, -2)
    expected = np.einsum("...i,...ij,...j->...", d, W, d)
    np.testing.assert_allclose(mahalanobis(jnp.asarray(d), jnp.asarray(W)), expected)


def test_noise_is_taken_where_matches_disagree_and_never_below_the_model():
    sensor = SensorModel(adaptation=0.5)
    noise = lambda before, misfit: float(
        adapt_inflation(sensor, jnp.array(before), jnp.array(misfit))
    )
    assert noise(1.0, 2.0) == 1
    assert noise(3.0, 2.0) == pytest.approx(3)
    assert noise(1.0, 4.0) == pytest.approx(np.exp(0.5))
    assert 1 < noise(3.0, 0.5) < 3
    assert noise(1.0, 0.0) == 1
    assert noise(8e3, 9.0) == sensor.noise_max  # grown so far, it could not be trusted again


def test_noise_beyond_the_gate_takes_weight_and_lets_no_more_match():
    sensor = SensorModel(noise_gate=4.0)
    for noise, variance, weight in (
        (1.0, 1.0, 1.0),
        (3.0, 3.0, 1.0),
        (4.0, 4.0, 1.0),
        (40.0, 4.0, 0.1),
    ):
        assert [float(x) for x in pixels_and_weight(sensor, jnp.array(noise))] == pytest.approx(
            [variance, weight]
        )
