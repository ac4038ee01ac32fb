"""The sensor model: sightings with their errors, and one pose against the map; III.A."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from conftest import jit_quickly

from sofjax.geometry import SE2, Mount, PolarLine, Segments
from sofjax.likelihood import (
    Candidates,
    SensorModel,
    Sightings,
    adapt_noise,
    compare,
    free_direction,
    mahalanobis,
    pixels_and_weight,
    sight,
)

pytestmark = pytest.mark.usefixtures("x64")

see, compare_pose = jit_quickly(sight), jit_quickly(compare)
DEPTH = 8.0
SEGMENTS = np.array(
    [
        [[60, 200], [260, 205]],  # across, near
        [[40, 90], [290, 96]],  # across, far
        [[100, 230], [140, 80]],  # along
        [[150, 220], [155, 62]],  # along, to beyond the greatest depth
        [[300, 150], [310, 200]],
    ],
    float,
)


def pose(x, y, yaw):
    return SE2(jnp.array([x, y], float), jnp.array(yaw, float))


def segments(ends, valid=True):
    """Padded to as many as there are in SEGMENTS: one shape, one compilation."""
    padded = np.zeros(SEGMENTS.shape)
    padded[: len(ends)] = ends
    return Segments(jnp.asarray(padded), (jnp.arange(len(padded)) < len(ends)) & valid)


@pytest.fixture
def rolled():
    return Mount.create(height=0.6, pitch=0.26, x=0.1, y=-0.05, roll=0.05, yaw=0.1)


def floor_lines(camera, mount, ends):
    """(rho, theta) about the foot of many segments [..., 2, 2] in plain numpy."""
    inverse = np.linalg.inv(reference.floor_homography(camera.K, mount, (0, 0, 0)))
    X = np.concatenate([ends, np.ones((*ends.shape[:-1], 1))], axis=-1) @ inverse.T
    points = X[..., :2] / X[..., 2:] - [float(mount.x), float(mount.y)]
    d = points[..., 1, :] - points[..., 0, :]
    theta = np.arctan2(d[..., 1], d[..., 0])
    return np.stack(
        [-np.sin(theta) * points[..., 0, 0] + np.cos(theta) * points[..., 0, 1], theta], -1
    )


# Sightings


def test_a_sighting_worked_by_hand(camera):
    # level, 1 m up: a row 54 px below the centre is 5 m away, and a pixel there 5² / 270 m
    level = Mount.create(height=1.0, x=0.2)
    across = segments([[[100.0, 173.5], [200.0, 173.5]]])
    found = see(SensorModel(pixel_sigma=0.5), camera, level, across, DEPTH)
    np.testing.assert_allclose(found.endpoints_foot[0], [[5, 59.5 / 54], [5, -40.5 / 54]])
    assert abs(found.line.rho[0]) == pytest.approx(5)  # about the foot, not the axle
    assert abs(found.line.theta[0]) == pytest.approx(np.pi / 2)
    # rho is at y = 0, between the ends: their noises are weighted by 40.5 and 59.5 per cent
    assert found.covariance[0, 0, 0] == pytest.approx(
        (0.5 * 25 / 270) ** 2 * (0.405**2 + 0.595**2), rel=1e-6
    )
    assert found.covariance[0, 1, 1] == pytest.approx(2 * (0.5 * 25 / 270 / (100 / 54)) ** 2)


def test_the_covariance_is_that_of_many_noisy_pixels(camera, rolled, rng):
    sensor = SensorModel(pixel_sigma=0.05)
    found = see(sensor, camera, rolled, segments(SEGMENTS), DEPTH)
    assert found.valid.all()
    noisy = SEGMENTS + rng.normal(0, 0.05, size=(20_000, *SEGMENTS.shape))
    lines = floor_lines(camera, rolled, noisy)
    np.testing.assert_allclose(
        np.stack([found.line.rho, found.line.theta], 1), lines.mean(0), atol=1e-3
    )
    for m in range(len(SEGMENTS)):
        covariance = np.cov(lines[:, m].T)
        scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
        np.testing.assert_allclose(found.covariance[m] / scale, covariance / scale, atol=0.05)


def test_a_far_segment_is_known_less_well(camera, mount):
    rows = (220.0, 160.0, 120.0, 90.0)
    across = segments([[[100, row], [220, row]] for row in rows])
    found = see(SensorModel(), camera, mount, across, DEPTH)
    sigma = np.sqrt(np.asarray(found.covariance[: len(rows), 0, 0]))
    assert (np.diff(sigma) > 0).all()


def test_noise_multiplies_the_variance_of_the_pixels(camera, mount):
    once, thrice = (
        see(SensorModel(), camera, mount, segments(SEGMENTS), DEPTH, noise) for noise in (1.0, 3.0)
    )
    np.testing.assert_allclose(thrice.covariance, 3 * once.covariance)
    np.testing.assert_array_equal(thrice.tilt, once.tilt)


def test_a_known_wobble_is_corrected(camera, rolled):
    """An image taken with the camera tipped by the wobble, put on the floor as if it were not."""
    wobble = np.array([0.002, -0.003])
    tipped = Mount.create(
        height=0.6, pitch=0.26 + wobble[0], x=0.1, y=-0.05, roll=0.05 + wobble[1], yaw=0.1
    )
    found = see(SensorModel(), camera, rolled, segments(SEGMENTS), DEPTH)
    true = floor_lines(camera, tipped, SEGMENTS)
    corrected = found.under_tilt(jnp.asarray(wobble))
    before = np.stack([found.line.rho, found.line.theta], 1) - true
    after = np.stack([corrected.rho, corrected.theta], 1) - true
    assert (np.linalg.norm(after, axis=1) < 0.05 * np.linalg.norm(before, axis=1)).all()


def test_the_paper_has_one_constant_sigma(camera, mount):
    sensor = SensorModel(propagate=False, rho_sigma=0.05, theta_sigma=0.03)
    found = see(sensor, camera, mount, segments(SEGMENTS), DEPTH)
    np.testing.assert_allclose(
        found.covariance, np.broadcast_to(np.diag([0.05**2, 0.03**2]), (5, 2, 2))
    )
    np.testing.assert_array_equal(found.tilt, 0)


def test_a_segment_whose_direction_is_hardly_known_is_no_sighting(camera, mount):
    short = segments([[[150, 150], [152, 150]], [[50, 150], [250, 150]]])
    found = see(SensorModel(theta_limit=0.2), camera, mount, short, DEPTH)
    np.testing.assert_array_equal(found.valid[:2], [False, True])


@pytest.mark.parametrize("propagate", [True, False])
def test_what_has_no_length_or_lies_above_the_horizon_is_no_sighting(camera, mount, propagate):
    ends = [[[150, 150], [150, 150]], [[10, 5], [300, 9]], [[50, 150], [250, 150]]]
    found = see(SensorModel(propagate=propagate), camera, mount, segments(ends), DEPTH)
    np.testing.assert_array_equal(found.valid[:3], [False, False, True])
    for leaf in jax.tree.leaves(found):
        assert np.isfinite(leaf).all()


def test_padding_is_no_sighting_and_finite(camera, mount):
    for ends in (np.zeros((5, 2, 2)), SEGMENTS):
        found = see(SensorModel(), camera, mount, segments(ends, valid=False), DEPTH)
        assert not found.valid.any()
        for leaf in jax.tree.leaves(found):
            assert np.isfinite(leaf).all()


# One pose against the map


def random_problem(rng, M=6, C=4):
    """Sightings near one of their candidates each, candidates of every kind, and some masked."""
    roots = rng.normal(size=(2, M, C, 2, 2))
    W = np.einsum("...ij,...kj->...ik", roots[0], roots[0]) * 1000 + 100 * np.eye(2)
    lines = np.stack([rng.normal(size=(M, C)) * 2, rng.uniform(-7, 7, size=(M, C))], -1)
    kappa = rng.uniform(0.8, 1.3, size=(M, C))
    near = lines[np.arange(M), rng.integers(C, size=M)] + rng.normal(0, 0.03, size=(M, 2))
    turns = rng.integers(-1, 2, size=M)  # named from either side
    near = np.stack([near[:, 0] * (-1.0) ** turns, near[:, 1] + turns * np.pi], 1)
    return near, lines, kappa, W, rng.random((M, C)) < 0.8


def as_arrays(near, lines, kappa, W, valid, tilt=None, sigma=0.0):
    M = len(near)
    tilt = np.zeros((M, 2, 2)) if tilt is None else tilt
    loose = np.linalg.inv(np.linalg.inv(W) + sigma**2 * (tilt @ np.swapaxes(tilt, 1, 2))[:, None])
    sightings = Sightings(
        endpoints_foot=jnp.zeros((M, 2, 2)),
        valid=jnp.ones(M, bool),
        line=PolarLine(jnp.asarray(near[:, 0]), jnp.asarray(near[:, 1])),
        covariance=jnp.broadcast_to(jnp.eye(2), (M, 2, 2)),
        tilt=jnp.asarray(tilt),
    )
    candidates = Candidates(
        PolarLine(jnp.asarray(lines[..., 0]), jnp.asarray(lines[..., 1])),
        jnp.asarray(kappa),
        jnp.asarray(W),
        jnp.asarray(loose),
        jnp.asarray(valid),
    )
    return sightings, candidates


def as_lists(lines, kappa, W, valid):
    return [
        [(*lines[m, k], kappa[m, k], W[m, k]) for k in range(len(kappa[m])) if valid[m, k]]
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
        np.testing.assert_array_equal(found.tilt, 0)
        inliers += int((found.error < STIFF.e_max).sum())
    assert inliers > 10


def test_the_wobble_is_the_one_that_costs_least(rng):
    """Against a search over all wobbles, the associations given."""
    sensor = SensorModel(tilt_sigma=0.01)
    for _ in range(4):
        near, lines, kappa, W, _ = random_problem(rng, C=1)
        J = rng.normal(size=(len(near), 2, 2))
        # the image was taken with a wobble; one segment shows something unknown
        wobble = rng.normal(size=2) * 0.01
        turns = np.round((near[:, 1] - lines[:, 0, 1]) / np.pi)
        near = np.stack([lines[:, 0, 0] * (-1.0) ** turns, lines[:, 0, 1] + np.pi * turns], 1)
        near = near + J @ wobble + rng.normal(0, 0.01, size=near.shape)
        near[0] += [5.0, 0.4]
        valid = np.ones(kappa.shape, bool)
        arrays = as_arrays(near, lines, kappa, W, valid, J, sensor.tilt_sigma)
        found = compare_pose(sensor, *arrays, SE2.identity(), jnp.ones(len(near), bool))
        assert found.error[0] == sensor.e_max

        def cost(tilt, near=near, lines=lines, W=W, J=J):
            total = tilt @ tilt / sensor.tilt_sigma**2 + sensor.e_max
            for m in range(1, len(near)):
                d = np.array(reference.polar_difference(near[m], lines[m, 0])) - J[m] @ tilt
                total += d @ W[m, 0] @ d
            return total

        best = reference.best_wobble(cost, sensor.tilt_sigma)
        np.testing.assert_allclose(found.tilt, best, atol=1e-6)
        assert (found.error[1:] < sensor.e_max).all()
        assert found.log_likelihood == pytest.approx(-cost(best) / 2, rel=1e-6)


def test_a_segment_that_matches_nothing_costs_e_max_once(rng):
    near, lines, kappa, W, valid = random_problem(rng)
    everything = jnp.ones(len(near), bool)
    valid = np.ones_like(valid)
    before = compare_pose(
        STIFF, *as_arrays(near, lines, kappa, W, valid), SE2.identity(), everything
    )
    assert before.error[0] < STIFF.e_max
    for far in (5.0, 5000.0):
        moved = np.array([near[0] + [far, 0.3], *near[1:]])
        after = compare_pose(
            STIFF, *as_arrays(moved, lines, kappa, W, valid), SE2.identity(), everything
        )
        cost = 2 * float(before.log_likelihood - after.log_likelihood)
        assert cost == pytest.approx(STIFF.e_max - float(before.error[0]))
        assert after.error[0] == STIFF.e_max


def test_an_empty_map_costs_e_max_for_every_segment_wherever_the_robot_is(rng):
    near, lines, kappa, W, valid = random_problem(rng)
    arrays = as_arrays(near, lines, kappa, W, np.zeros_like(valid))
    for T in rng.normal(size=(3, 3)):
        found = compare_pose(STIFF, *arrays, pose(*T), jnp.ones(6, bool))
        assert found.log_likelihood == pytest.approx(-6 * STIFF.e_max / 2)


def test_what_is_not_valid_counts_nothing_and_what_may_not_match_costs_the_most(rng):
    near, lines, kappa, W, valid = random_problem(rng)
    mask = np.array([True, False, True, True, False, True])
    expected = reference.log_likelihood(
        near[mask],
        mask[mask],
        as_lists(lines[mask], kappa[mask], W[mask], valid[mask]),
        9.0,
        np.zeros(3),
    )
    sightings, candidates = as_arrays(near, lines, kappa, W, valid)
    unused = compare_pose(STIFF, sightings, candidates, SE2.identity(), jnp.asarray(mask))
    padded = Sightings(
        sightings.endpoints_foot,
        jnp.asarray(mask),
        sightings.line,
        sightings.covariance,
        sightings.tilt,
    )
    invalid = compare_pose(STIFF, padded, candidates, SE2.identity(), jnp.ones(6, bool))
    assert invalid.log_likelihood == pytest.approx(expected)
    assert unused.log_likelihood == pytest.approx(expected - 2 * 9.0 / 2)
    nothing = compare_pose(STIFF, sightings, candidates, SE2.identity(), jnp.zeros(6, bool))
    assert nothing.log_likelihood == pytest.approx(-6 * 9.0 / 2)


def test_the_choice_is_the_candidate_that_costs_least(rng):
    near, lines, kappa, W, valid = random_problem(rng)
    valid = np.ones_like(valid)
    found = compare_pose(
        STIFF, *as_arrays(near, lines, kappa, W, valid), SE2.identity(), jnp.ones(6, bool)
    )
    for m in range(6):
        errors = [
            np.array(d) @ W[m, k] @ d
            for k in range(4)
            for d in [reference.polar_difference(near[m], lines[m, k])]
        ]
        assert found.choice[m] == np.argmin(errors)


def test_a_raised_line_moves_by_its_magnification():
    """Driving 10 cm nearer to a line that seems 1.5 times as far brings its image 15 cm nearer."""
    W = np.broadcast_to(1e4 * np.eye(2), (1, 1, 2, 2))
    arrays = as_arrays(
        np.array([[2.85, 0.0]]), np.array([[[3.0, 0.0]]]), np.full((1, 1), 1.5), W, [[True]]
    )
    found = compare_pose(STIFF, *arrays, pose(0, 0.1, 0), jnp.ones(1, bool))
    assert found.log_likelihood == pytest.approx(0, abs=1e-12)


def test_the_true_pose_is_the_most_likely(rng):
    """Exact sightings of a few lines, from a place off the predicted one."""
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


def along(*theta, sigma=0.01):
    theta = jnp.array(theta)
    line = PolarLine(jnp.ones_like(theta), theta)
    covariance = jnp.broadcast_to(jnp.diag(jnp.array([1e-4, sigma**2])), (len(theta), 2, 2))
    none = jnp.zeros_like(covariance)
    return Sightings(none, theta < 9, line, covariance, none)


def test_lines_that_all_run_one_way_leave_it_free():
    all_known = lambda s: free_direction(s, s.valid)
    free, parallel = all_known(along(0.3, 0.32, 0.29, 0.3 + np.pi, 0.3 - np.pi))
    assert parallel and np.sin(free - 0.3) == pytest.approx(0, abs=0.01)
    assert not all_known(along(0.3, 0.3, 0.3, 0.5))[1]
    assert not all_known(along(0.3, 0.3, 0.3, 0.3 + np.pi / 2))[1]
    assert all_known(along(0.3, 0.3, 0.3, 0.5, sigma=0.1))[1]  # as far as can be seen
    assert all_known(along(np.pi / 2, -np.pi / 2))[1]


def test_what_is_not_known_tells_no_direction():
    sightings = along(0.3, 0.31, 1.5)
    assert free_direction(sightings, jnp.array([True, True, False]))[1]
    assert not free_direction(sightings, jnp.array([True, True, True]))[1]
    free, parallel = free_direction(sightings, jnp.zeros(3, bool))
    assert not parallel and np.isfinite(free)


def test_noise_is_believed_where_matches_disagree_and_never_below_the_model():
    sensor = SensorModel(adaptation=0.5)
    noise = lambda before, misfit: float(adapt_noise(sensor, jnp.array(before), jnp.array(misfit)))
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
