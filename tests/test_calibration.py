"""The mount from pairs of segments: recovered, with honest errors, refused if unobservable."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from conftest import jit_quickly
from line_pairs import (
    FIT,
    N,
    begin,
    changes,
    fit_from,
    fit_mount,
    make_pairs,
    off,
    off_by,
    true_mount,
    value,
    weighed,
)

from sofjax.calibration import TURNS, UNKNOWNS, FitConfig
from sofjax.geometry import SE2, projection_matrix

pytestmark = pytest.mark.usefixtures("x64")


@pytest.fixture
def mount():
    return true_mount()


@pytest.fixture
def pairs(camera, mount, rng):
    return make_pairs(camera, mount, rng)


def test_distances_are_those_of_the_ends_from_the_other_s_line(camera, mount, pairs):
    """By points: both ends go from image to floor, to the other robot, and into its image."""
    lower = off(mount, 0.8, 0.05)
    T = jax.tree.map(lambda x: x[0], pairs.T_first_second)
    got = off_by(begin(camera, lower), pairs.first[0], pairs.second[0], T)
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
        off_by(begin(camera, mount), pairs.first[0], pairs.second[0], T), 0, atol=1e-9
    )


def test_exact_pairs_give_the_exact_mount_from_far_off(camera, mount, pairs):
    found = fit_mount(camera, off(mount, 1.3, -0.14, 0.1), pairs)
    assert found.result == optx.RESULTS.successful
    np.testing.assert_allclose(value(found), list(FIT.values()), atol=3e-5)
    assert np.abs(found.residuals).max() < 0.02
    np.testing.assert_array_equal(found.observable, [True] * 3 + [False] * 14)
    assert (float(found.mount.x), float(found.mount.yaw)) == (0.05, 0.0)


def test_twenty_four_starts_at_once_end_in_one_place(camera, mount, rng):
    pairs = make_pairs(camera, mount, rng, noise=0.5)
    times, pitch = jnp.meshgrid(jnp.linspace(0.7, 1.3, 6), jnp.radians(jnp.linspace(-8, 8, 4)))
    begin = jax.vmap(lambda t, p: off(mount, t, p))(times.ravel(), pitch.ravel())
    ends = jit_quickly(jax.vmap(lambda m: fit_from(camera, m, pairs).mount))(begin)
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
    bias = dict(left=0.02, right=-0.06, curvature=0.004)  # as wheels of two sizes do
    turned = eqx.tree_at(lambda m: m.yaw, mount, jnp.asarray(0.06))
    read = SE2(jnp.asarray(motion[:, :2]), jnp.asarray(motion[:, 2]))
    did = jax.vmap(begin(camera, mount).moved(changes(**bias)).motion)(read)
    pairs = make_pairs(camera, turned, rng, np.column_stack([did.xy, did.yaw]))
    pairs = eqx.tree_at(lambda p: p.T_first_second, pairs, read)
    config = FitConfig(free=("height", "pitch", "roll", "yaw", *TURNS), prior_sigma=(9.0,) * 17)
    found = fit_mount(camera, mount, pairs, config)
    np.testing.assert_allclose(value(found), list(FIT.values()), atol=1e-3)
    assert float(found.mount.yaw) == pytest.approx(0.06, abs=1e-3)
    np.testing.assert_allclose(found.odometer, [0.0, *bias.values()], atol=1e-3)


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
    i = UNKNOWNS.index("distance")
    C, prior = np.asarray(found.covariance), config.prior_sigma[i]
    correlation = C[0, i] / np.sqrt(C[0, 0] * C[i, i])
    assert correlation > 0.8
    assert np.sqrt(C[i, i]) == pytest.approx(prior, rel=0.2)
    assert np.sqrt(C[0, 0]) == pytest.approx(prior, rel=0.3)


def implicit(camera, mount, pairs):
    """The fitted (height, pitch, roll) by one end point, the path driven and the focal length."""

    def fitted(x):
        moved = eqx.tree_at(lambda p: p.second, pairs, pairs.second.at[3, 0].add(x[:2]))
        T = pairs.T_first_second
        moved = eqx.tree_at(lambda p: p.T_first_second.xy, moved, T.xy * (1 + x[2]))
        other = eqx.tree_at(lambda c: c.K, camera, camera.K.at[0, 0].add(x[3]))
        m = fit_from(other, mount, moved).mount
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
        found = fit_from(camera, mount, weighed(camera, mount, pairs))
        return jnp.stack(
            [found.mount.height, found.mount.pitch, found.mount.roll]
        ), found.covariance

    got, covariance = jax.jit(jax.vmap(one))(*draws)
    error = np.asarray(got) - list(FIT.values())
    unit = [FIT["height"], 1, 1]
    sigma = unit * np.sqrt(np.asarray(covariance)[:, range(3), range(3)])
    inside = np.abs(error) < 2 * sigma
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
            moved = begin(camera, mount).moved(jnp.zeros(17).at[:3].set(by))
            return off_by(moved, first, second, T)[:2]

        J, a, b = jax.jacfwd(of, (0, 1, 2))(jnp.zeros(3), pairs.first[k], pairs.second[k])
        noise = np.concatenate([np.reshape(a, (2, 4)), np.reshape(b, (2, 4))], axis=1)
        information += J.T @ np.linalg.solve(sigma**2 * noise @ noise.T, J)
    return np.sqrt(np.diag(np.linalg.inv(information))) * [float(mount.height), 1, 1]


def test_unknowns_are_in_the_order_of_the_covariance(camera, mount, pairs):
    found = fit_mount(camera, mount, pairs, FitConfig(free=("pitch",)))
    assert UNKNOWNS[1] == "pitch"
    assert np.flatnonzero(np.diag(np.asarray(found.covariance)) > 0).tolist() == [1]
