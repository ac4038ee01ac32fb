"""The mount from pairs of segments: recovered, with honest errors, refused if unobservable."""

import dataclasses
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from conftest import jit_quickly, make_camera

from sofjax.calibration import (
    TURNS,
    UNKNOWNS,
    FitConfig,
    PairNoise,
    SegmentPairs,
    distances,
    expected,
)
from sofjax.calibration import fit_mount as compiled_well
from sofjax.calibration.assessment import FitOutcome, ambiguity, assess, doubts
from sofjax.calibration.fit_drive import DriveFitConfig
from sofjax.calibration.floor_test import FloorTestConfig, lies_on_floor
from sofjax.calibration.pairs import Estimate, start_at
from sofjax.calibration.tracks import TrackConfig, follow, relate
from sofjax.extraction.observation import Observation
from sofjax.geometry import SE2, Mount, Segments, projection_matrix
from sofjax.motion import without_unread_motions

pytestmark = pytest.mark.usefixtures("x64")

N = 96
MOUNT = (0.05, 0.0, 0.6, 0.26, 0.02, 0.0)  # x, y, height, pitch, roll, yaw


@jit_quickly
def fit_mount(camera, mount, pairs, config=None):
    return compiled_well(camera, mount, pairs, config or FitConfig())


FIT = {"height": 0.6, "pitch": 0.26, "roll": 0.02}


@pytest.fixture
def camera():
    return make_camera()


@pytest.fixture
def mount():
    return Mount(*map(jnp.asarray, MOUNT))


def off(mount, times=1.0, pitch=0.0, roll=0.0):
    return eqx.tree_at(
        lambda m: (m.height, m.pitch, m.roll),
        mount,
        (mount.height * times, mount.pitch + pitch, mount.roll + roll),
    )


def seen(camera, mount, pose, points):
    """World points [N, 2, 3] in an image, pixels, by the plain projection."""
    P = np.asarray(
        projection_matrix(camera, mount, SE2(jnp.asarray(pose[:2]), jnp.asarray(pose[2])))
    )
    x = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=-1) @ P.T
    assert (x[..., 2] > 0).all()
    return x[..., :2] / x[..., 2:]


def make_pairs(camera, mount, rng, motion=None, angle=None, noise=0.0, z=0.0):
    """N lines of the floor, each seen before and after a motion of its own."""
    first = np.stack(
        [rng.uniform(-0.2, 0.2, N), rng.uniform(-0.1, 0.1, N), rng.uniform(-1, 1, N)], 1
    )
    if motion is None:
        motion = np.stack(
            [rng.uniform(0.3, 0.9, N), rng.normal(0, 0.02, N), rng.normal(0, 0.05, N)], axis=1
        )
    T1 = SE2(jnp.asarray(first[:, :2]), jnp.asarray(first[:, 2]))
    T12 = SE2(jnp.asarray(motion[:, :2]), jnp.asarray(motion[:, 2]))
    T2 = T1 @ T12
    middle = np.stack([rng.uniform(1.7, 4, N), rng.uniform(-0.8, 0.8, N)], axis=1)
    angle = rng.uniform(0, np.pi, N) if angle is None else angle
    along = rng.uniform(0.15, 0.4, N)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ends = np.asarray(T1.apply(jnp.asarray(np.stack([middle - along, middle + along])))).swapaxes(
        0, 1
    )
    height = np.broadcast_to(z, N)[:, None, None] * np.ones((N, 2, 1))
    points = np.concatenate([ends, height], axis=-1)
    images = []
    for T in (T1, T2):
        poses = np.concatenate([np.asarray(T.xy), np.asarray(T.yaw)[:, None]], axis=1)
        images.append(np.concatenate([
            seen(camera, mount, pose, point[None])
            for pose, point in zip(poses, points, strict=True)
        ]))  # fmt: skip
    images = [image + rng.normal(0, noise, image.shape) for image in images]
    return SegmentPairs(
        *map(jnp.asarray, images), T12, jnp.ones(N, bool), jnp.ones((N, 4)), jnp.arange(N)
    )


def weighed(camera, mount, pairs, **noise):
    return eqx.tree_at(
        lambda p: p.sigma, pairs, expected(PairNoise(**noise), camera, start_at(mount), pairs)
    )


@pytest.fixture
def pairs(camera, mount, rng):
    return make_pairs(camera, mount, rng)


def value(result):
    return np.array([result.mount.height, result.mount.pitch, result.mount.roll])


def test_distances_are_those_of_the_ends_from_the_other_s_line(camera, mount, pairs):
    """By points: both ends go from image to floor, to the other robot, and into its image."""
    lower = off(mount, 0.8, 0.05)
    T = jax.tree.map(lambda x: x[0], pairs.T_first_second)
    got = distances(camera, start_at(lower), pairs.first[0], pairs.second[0], T)
    here = np.asarray(projection_matrix(camera, lower, SE2.identity()))[:, [0, 1, 3]]
    there = np.asarray(projection_matrix(camera, lower, T))[:, [0, 1, 3]]
    want = []
    for H, a, b in ((there @ np.linalg.inv(here), pairs.first[0], pairs.second[0]),
                    (here @ np.linalg.inv(there), pairs.second[0], pairs.first[0])):  # fmt: skip
        x = np.concatenate([a, np.ones((2, 1))], axis=1) @ H.T
        x = x[:, :2] / x[:, 2:]
        d = (x[1] - x[0]) / np.linalg.norm(x[1] - x[0])
        want += list((np.asarray(b) - x[0]) @ [-d[1], d[0]])
    np.testing.assert_allclose(np.abs(got), np.abs(want), atol=1e-9)
    np.testing.assert_allclose(
        distances(camera, start_at(mount), pairs.first[0], pairs.second[0], T), 0, atol=1e-9
    )


def test_exact_pairs_give_the_exact_mount_from_far_off(camera, mount, pairs):
    found = fit_mount(camera, off(mount, 1.3, -0.14, 0.1), pairs)
    assert found.result == optx.RESULTS.successful
    np.testing.assert_allclose(value(found), list(FIT.values()), atol=3e-5)
    assert np.abs(found.residuals).max() < 0.02
    np.testing.assert_array_equal(found.observable, [True] * 3 + [False] * 5)
    assert (float(found.mount.x), float(found.mount.yaw)) == (0.05, 0.0)


def test_twenty_four_starts_at_once_end_in_one_place(camera, mount, rng):
    pairs = make_pairs(camera, mount, rng, noise=0.5)
    times, pitch = jnp.meshgrid(jnp.linspace(0.7, 1.3, 6), jnp.radians(jnp.linspace(-8, 8, 4)))
    begin = jax.vmap(lambda t, p: off(mount, t, p))(times.ravel(), pitch.ravel())
    ends = jit_quickly(jax.vmap(lambda m: compiled_well(camera, m, pairs).mount))(begin)
    assert max(np.ptp(ends.height), np.ptp(ends.pitch), np.ptp(ends.roll)) < 1e-4


def test_padding_and_units_do_not_matter(camera, mount, pairs, rng):
    rubbish = eqx.tree_at(
        lambda p: (p.second, p.valid),
        pairs,
        (pairs.second.at[::3].add(50.0), pairs.valid.at[::3].set(False)),
    )
    found = fit_mount(camera, off(mount, 0.8), rubbish)
    np.testing.assert_allclose(value(found), list(FIT.values()), atol=3e-5)
    assert float(jnp.abs(found.residuals[::3]).max()) == 0
    # all lengths three times as long: the same angles, three times the height
    scaled = eqx.tree_at(lambda p: p.T_first_second.xy, pairs, 3 * pairs.T_first_second.xy)
    big = eqx.tree_at(lambda m: m.x, off(mount, 3), 3 * mount.x)
    found = fit_mount(camera, big, scaled)
    np.testing.assert_allclose(value(found), [1.8, 0.26, 0.02], atol=3e-5)


def test_yaw_and_the_odometer_s_turns_can_be_free_too(camera, mount, rng):
    motion = np.stack(
        [rng.uniform(0.3, 0.9, N), rng.normal(0, 0.02, N), rng.choice([-0.3, 0.3], N)], axis=1
    )
    bias = jnp.array([0.0, 0.02, -0.06, 0.004])  # left and right turns, as wheels of two sizes do
    turned = eqx.tree_at(lambda m: m.yaw, mount, jnp.asarray(0.06))
    read = SE2(jnp.asarray(motion[:, :2]), jnp.asarray(motion[:, 2]))
    did = jax.vmap(Estimate(mount, bias).motion)(read)
    pairs = make_pairs(camera, turned, rng, np.column_stack([did.xy, did.yaw]))
    pairs = eqx.tree_at(lambda p: p.T_first_second, pairs, read)
    config = FitConfig(free=("height", "pitch", "roll", "yaw", *TURNS), prior_sigma=(9.0,) * 8)
    found = fit_mount(camera, mount, pairs, config)
    np.testing.assert_allclose(value(found), list(FIT.values()), atol=1e-3)
    assert float(found.mount.yaw) == pytest.approx(0.06, abs=1e-3)
    np.testing.assert_allclose(found.odometer, bias, atol=1e-3)


def test_an_odometer_put_far_off_its_prior_widens_all_error_bars(camera, mount, rng):
    """The same drive, read right and read 30 % short in left turns, is known less by the ratio."""
    motion = np.stack(
        [rng.uniform(0.3, 0.9, N), rng.normal(0, 0.02, N), rng.uniform(0.1, 0.3, N)], axis=1
    )
    pairs = weighed(camera, mount, make_pairs(camera, mount, rng, motion, noise=0.3))
    short = eqx.tree_at(
        lambda p: p.T_first_second,
        pairs,
        jax.vmap(Estimate(mount, jnp.array([0.0, -0.3, 0.0, 0.0])).motion)(pairs.T_first_second),
    )
    config = FitConfig(free=("height", "pitch", "roll", "left"))
    right, wrong = (fit_mount(camera, mount, p, config) for p in (pairs, short))
    assert float(right.birge_ratio) == 1 and doubts(right) == ""
    sigmas = float(wrong.odometer[1]) / config.prior_sigma[5]
    assert float(wrong.birge_ratio) == pytest.approx(abs(sigmas)) and sigmas > 5
    assert "clock or odometer" in doubts(wrong)
    ratio = np.sqrt(np.diag(wrong.covariance)[:3] / np.diag(right.covariance)[:3])
    np.testing.assert_allclose(ratio, sigmas, rtol=0.3)


def test_outliers_hardly_matter(camera, mount, rng):
    pairs = make_pairs(camera, mount, rng, noise=0.3)
    wrong = pairs.second.at[::4].add(jnp.asarray(rng.normal(0, 20, (N // 4, 2, 2))))
    found = fit_mount(camera, off(mount, 1.2, 0.1), eqx.tree_at(lambda p: p.second, pairs, wrong))
    assert (np.abs(value(found) - list(FIT.values())) < [0.012, 0.005, 0.01]).all()


def test_height_and_the_odometer_s_scale_are_one(camera, mount, rng):
    """Both free, the priors alone share them out, and the covariance says so."""
    pairs = make_pairs(camera, mount, rng, noise=0.3)
    config = FitConfig(free=("height", "pitch", "roll", "distance"))
    found = fit_mount(camera, mount, pairs, config)
    C = np.asarray(found.covariance)
    correlation = C[0, 4] / np.sqrt(C[0, 0] * C[4, 4])
    assert correlation > 0.8
    assert np.sqrt(C[4, 4]) == pytest.approx(0.02, rel=0.2)
    assert np.sqrt(C[0, 0]) / 0.6 == pytest.approx(0.02, rel=0.3)


def implicit(camera, mount, pairs):
    """The fitted (height, pitch, roll) by one end point, the path driven and the focal length."""

    def fitted(x):
        moved = eqx.tree_at(lambda p: p.second, pairs, pairs.second.at[3, 0].add(x[:2]))
        T = pairs.T_first_second
        moved = eqx.tree_at(lambda p: p.T_first_second.xy, moved, T.xy * (1 + x[2]))
        other = eqx.tree_at(lambda c: c.K, camera, camera.K.at[0, 0].add(x[3]))
        m = compiled_well(other, mount, moved).mount
        return jnp.stack([m.height, m.pitch, m.roll])

    return fitted


@pytest.mark.slow
def test_the_derivative_of_the_fit_is_that_of_finite_differences(camera, mount, rng):
    pairs = make_pairs(camera, mount, rng, noise=0.5)
    fitted = implicit(camera, mount, pairs)
    steps = np.array([0.3, 0.3, 1e-2, 1.0])
    J = jit_quickly(jax.jacrev(fitted))(jnp.zeros(4))
    fitted = jit_quickly(fitted)
    assert np.isfinite(J).all()
    for i, h in enumerate(steps):
        e = np.eye(4)[i] * h
        up, down = fitted(jnp.asarray(e)), fitted(jnp.asarray(-e))
        np.testing.assert_allclose(J[:, i], (up - down) / (2 * h), rtol=0.02, atol=2e-6)


@pytest.mark.slow
def test_truth_lies_within_the_error_bars_and_the_error_is_near_the_bound(camera, mount):
    """Two hundred logs: near the Cramér-Rao bound, and inside 2 sigma as often as it must."""
    rng = np.random.default_rng(3)
    clean = make_pairs(camera, mount, rng)
    draws = jnp.asarray(rng.normal(0, 0.5, (2, 200, N, 2, 2)))

    def one(a, b):
        pairs = eqx.tree_at(
            lambda p: (p.first, p.second), clean, (clean.first + a, clean.second + b)
        )
        found = compiled_well(camera, mount, weighed(camera, mount, pairs))
        return jnp.stack(
            [found.mount.height, found.mount.pitch, found.mount.roll]
        ), found.covariance

    got, covariance = jax.jit(jax.vmap(one))(*draws)
    error = np.asarray(got) - list(FIT.values())
    inside = np.abs(error) < 2 * np.sqrt(np.asarray(covariance)[:, range(3), range(3)])
    assert (inside.mean(0) > 0.9).all() and (inside.mean(0) <= 0.99).all(), inside.mean(0)
    rms = np.sqrt(np.mean(error**2, axis=0))
    assert (rms < 1.3 * cramer_rao(camera, mount, clean, 0.5)).all()


def cramer_rao(camera, mount, pairs, sigma):
    """Least standard deviations of (height, pitch, roll), every line unknown, by plain algebra.

    What a pair says of the mount is the two distances, as far as noise of both segments lets it.
    """
    information = np.zeros((3, 3))
    for k in range(N):
        T = jax.tree.map(lambda x, k=k: x[k], pairs.T_first_second)

        def of(by, first, second, T=T):
            moved = start_at(mount).moved(jnp.concatenate([by, jnp.zeros(5)]))
            return distances(camera, moved, first, second, T)[:2]

        J, a, b = jax.jacfwd(of, (0, 1, 2))(jnp.zeros(3), pairs.first[k], pairs.second[k])
        noise = np.concatenate([np.reshape(a, (2, 4)), np.reshape(b, (2, 4))], axis=1)
        information += J.T @ np.linalg.solve(sigma**2 * noise @ noise.T, J)
    return np.sqrt(np.diag(np.linalg.inv(information))) * [float(mount.height), 1, 1]


def refusal(camera, mount, pairs):
    config = FitConfig()
    found = fit_mount(camera, mount, weighed(camera, mount, pairs), config)
    assessment = assess(found, config, pairs)
    assert not assessment.usable
    assert np.isfinite(found.covariance).all()
    return found, assessment


def test_a_pure_rotation_has_no_height(camera, mount, rng):
    centred = eqx.tree_at(lambda m: m.x, mount, jnp.zeros(()))
    motion = np.stack([np.zeros(N), np.zeros(N), rng.uniform(-0.25, 0.25, N)], axis=1)
    pairs = make_pairs(camera, centred, rng, motion, noise=0.3)
    found, refused = refusal(camera, centred, pairs)
    assert not bool(found.observable[0]) and int(np.abs(found.weakest).argmax()) == 0
    assert refused.outcome is FitOutcome.NOT_OBSERVABLE and "height" in refused.sentence


def test_lines_along_the_motion_have_no_height(camera, mount, rng):
    motion = np.stack([rng.uniform(0.3, 0.9, N), np.zeros(N), np.zeros(N)], axis=1)
    pairs = make_pairs(camera, mount, rng, motion, angle=np.zeros(N), noise=0.3)
    found, refused = refusal(camera, mount, pairs)
    assert not bool(found.observable[0]) and "height" in refused.sentence


def test_few_pairs_are_none(camera, mount, pairs):
    few = eqx.tree_at(lambda p: p.valid, pairs, jnp.arange(N) < 12)
    found, refused = refusal(camera, mount, few)
    assert refused.outcome is FitOutcome.TOO_FEW_PAIRS
    assert not found.observable.any() and "12 pairs" in refused.sentence
    found, refused = refusal(
        camera, mount, eqx.tree_at(lambda p: p.valid, pairs, jnp.zeros(N, bool))
    )
    assert "0 pairs" in refused.sentence and np.isfinite(value(found)).all()


def test_what_stands_above_the_floor_is_told_by_its_height(camera, mount, rng):
    z = np.where(np.arange(N) // 6 % 3 == 0, 0.1, 0.0)  # six pairs of each line
    pairs = weighed(camera, mount, make_pairs(camera, mount, rng, noise=0.3, z=z))
    line = jnp.arange(N) // 6
    floor = np.asarray(lies_on_floor(FloorTestConfig(), camera, start_at(mount), pairs, line))
    assert floor[z == 0].mean() > 0.9 and floor[z > 0].mean() < 0.3
    wild = eqx.tree_at(
        lambda p: p.second, pairs, pairs.second + jnp.asarray(rng.normal(0, 15, (N, 2, 2)))
    )
    assert not np.asarray(
        lies_on_floor(FloorTestConfig(), camera, start_at(mount), wild, line)
    ).any()


@pytest.fixture
def log(camera, mount, rng):
    """Forty images on a straight path over twelve lines, slightly noisy; one is missed once."""
    ends = np.zeros((12, 2, 3))
    angle = np.linspace(0.3, 2.8, 12)
    along = 0.3 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    middle = np.stack([np.linspace(3, 5, 12), np.linspace(-0.7, 0.7, 12)], axis=1)
    ends[..., :2] = np.stack([middle - along, middle + along], axis=1)
    images = [seen(camera, mount, (0.05 * i, 0.0, 0.0), ends) for i in range(40)]
    endpoints = np.zeros((40, 16, 2, 2))
    order = np.stack([rng.permutation(12) for _ in range(40)])
    endpoints[:, :12] = np.stack([image[p] for image, p in zip(images, order, strict=True)])
    endpoints[:, :12] += rng.normal(0, 0.2, (40, 12, 2, 2))
    valid = np.broadcast_to(np.arange(16) < 12, (40, 16)).copy()
    valid[20, np.flatnonzero(order[20] == 5)] = False
    motion = SE2(jnp.tile(jnp.array([[0.05, 0.0]]), (40, 1)).at[0].set(0), jnp.zeros(40))
    log = Observation(
        Segments(jnp.asarray(endpoints), jnp.asarray(valid)), motion, jnp.zeros(40, int)
    )
    return log, order


def test_lines_are_followed_though_missed_once_and_the_mount_is_rough(camera, mount, log):
    log, order = log
    track = follow(TrackConfig(), camera, start_at(off(mount, 1.25, 0.1)), log)
    assert (track[:, 12:] == -1).all() and (track[20] == -1).sum() == 5
    of_line = np.where(track[:, :12] >= 0, track[:, :12], 0)
    for t in range(1, 40):
        for m in range(12):
            before = int(np.flatnonzero(order[t - 1] == order[t, m])[0])
            if track[t, m] >= 0 and track[t - 1, before] >= 0:
                assert of_line[t, m] == of_line[t - 1, before]
    gap = [track[t, np.flatnonzero(order[t] == 5)[0]] for t in (19, 21)]
    assert gap[0] == gap[1] >= 0


def test_nothing_is_followed_over_a_motion_that_nobody_read(camera, mount, log):
    log, _ = log
    config = TrackConfig()
    unread = dataclasses.replace(log, motion_sigma=jnp.zeros((40, 3)).at[20].set(0.1))
    track = follow(config, camera, start_at(mount), unread)
    before, behind = (np.unique(part[part >= 0]) for part in (track[:20], track[20:]))
    assert len(before) == 12 and not np.intersect1d(before, behind).size
    known = without_unread_motions(log)
    assert known is log
    xy = log.motion.xy.at[20, 0].set(jnp.nan)
    nan = dataclasses.replace(log, motion=SE2(xy, log.motion.yaw))
    known = without_unread_motions(nan)
    assert (np.flatnonzero(np.asarray(known.motion_sigma).any(axis=1)) == [20]).all()
    assert np.isfinite(known.motion.xy).all()
    np.testing.assert_array_equal(known.motion.xy[:20], log.motion.xy[:20])


def test_pairs_are_nested_and_use_each_segment_once(camera, mount, log):
    log, _ = log
    track = follow(TrackConfig(), camera, start_at(mount), log)
    pairs, line = relate(TrackConfig(), log, track, 0.6, 256)
    valid = np.asarray(pairs.valid)
    assert valid.sum() > 60 and len(np.unique(np.asarray(line)[valid])) == 12
    path = np.asarray(pairs.T_first_second.xy)[valid, 0]
    assert path.min() >= 0.3 - 1e-9 and path.max() <= 1.2 + 1e-9
    used = np.concatenate([np.asarray(pairs.first)[valid], np.asarray(pairs.second)[valid]])
    assert len(np.unique(used.reshape(-1, 4), axis=0)) == len(used)
    assert (np.asarray(line)[~valid] == -1).all()
    few, _ = relate(TrackConfig(), log, track, 0.6, 32)
    assert np.asarray(few.valid).all() and len(few.valid) == 32
    found = fit_mount(camera, off(mount, 1.2, 0.08), pairs)
    np.testing.assert_allclose(value(found), list(FIT.values()), atol=0.01)


def test_unknowns_are_in_the_order_of_the_covariance(camera, mount, pairs):
    found = fit_mount(camera, mount, pairs, FitConfig(free=("pitch",)))
    assert UNKNOWNS[1] == "pitch"
    assert np.flatnonzero(np.diag(np.asarray(found.covariance)) > 0).tolist() == [1]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: FitConfig(free=("pitch", "heigth")), "FitConfig.free must be some of height"),
        (lambda: FitConfig(min_pairs=0), "FitConfig.min_pairs must be a whole number from 1"),
        (lambda: FitConfig(limit=(0.05, 0.02)), "FitConfig.limit must be 8 numbers above 0"),
        (lambda: FitConfig(prior_sigma=(-1.0,) * 8), "FitConfig.prior_sigma must be 8 numbers"),
        (lambda: FloorTestConfig(max_rms=0.0), "FloorTestConfig.max_rms must be a number above 0"),
        (lambda: TrackConfig(max_lag=0), "TrackConfig.max_lag must be a whole number from 1"),
        (lambda: PairNoise(pixel_sigma=-0.5), "PairNoise.pixel_sigma must be a number from 0"),
        (lambda: DriveFitConfig(starts=()), "DriveFitConfig.starts must be one or more pairs"),
        (lambda: DriveFitConfig(capacity=0), "DriveFitConfig.capacity must be a whole number"),
    ],
)
def test_bad_settings_are_refused_by_name(make, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        make()


def test_starts_that_end_in_different_places_are_ambiguous():
    found = ambiguity(np.array([[0.6, 0.26, 0.02], [0.7, 0.26, 0.03]]))
    assert found.outcome is FitOutcome.AMBIGUOUS and not found.usable
    assert "from 2 starts" in found.sentence and "heights 0.600 to 0.700 m" in found.sentence
    assert "pitch" not in found.sentence and "roll 1.1 to 1.7°" in found.sentence
