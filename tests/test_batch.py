"""The batch functions against a plain float64 reference: random, degenerate, full-size inputs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import jit_quickly

from sofjax.extraction.sof import put_on_floor
from sofjax.geometry import SE2, Camera, Mount, Segments
from sofjax.likelihood import LineNoise
from sofjax.likelihood.batch import (
    image_log_likelihood,
    log_likelihood,
    log_likelihood_pruned,
)
from sofjax.likelihood.batch.evaluate import _log_likelihood

NOISE = (0.15, 0.08, 9.0)  # rho_sigma, theta_sigma, e_max of the reference
NOISY = LineNoise(*NOISE)


# --- the reference: one particle at a time, every pair, the definition as it is written


def reference(particles, observed, segment_map, sigma_rho, sigma_theta, e_max, *,
              soft=False, used=None, covariance=None, overlap_scale=0.05):  # fmt: skip
    f8 = lambda a: np.asarray(a, np.float64)
    seen, ends = f8(observed.endpoints), f8(segment_map.endpoints)
    cov = np.zeros((len(seen), 2, 2)) if covariance is None else f8(covariance)
    cov = cov + np.diag([float(sigma_rho) ** 2, float(sigma_theta) ** 2])
    precision = np.linalg.inv(cov)
    d = seen[:, 1] - seen[:, 0]
    length = np.linalg.norm(d, axis=1)
    unit = d / np.where(length > 0, length, 1)[:, None]
    normal = np.stack([-unit[:, 1], unit[:, 0]], 1)
    rho, theta = (normal * seen[:, 0]).sum(1), np.arctan2(unit[:, 1], unit[:, 0])
    extent = np.sort((seen * unit[:, None]).sum(-1), axis=1)
    out = []
    for n, (xy, yaw) in enumerate(zip(f8(particles.xy), f8(particles.yaw), strict=True)):
        c, s = np.cos(yaw), np.sin(yaw)
        local = (ends - xy) @ np.array([[c, -s], [s, c]])
        dk = local[:, 1] - local[:, 0]
        length_k = np.linalg.norm(dk, axis=1)
        unit_k = dk / np.where(length_k > 0, length_k, 1)[:, None]
        normal_k = np.stack([-unit_k[:, 1], unit_k[:, 0]], 1)
        rho_k, theta_k = (normal_k * local[:, 0]).sum(1), np.arctan2(unit_k[:, 1], unit_k[:, 0])
        turn = theta[:, None] - theta_k
        half_turns = np.round(turn / np.pi)
        side = np.where(half_turns % 2 == 0, 1, -1)
        delta = np.stack([rho[:, None] - side * rho_k, turn - np.pi * half_turns], -1)
        e = np.einsum("mki,mij,mkj->mk", delta, precision, delta)
        extent_k = np.sort(np.einsum("kej,mj->mke", local, unit), axis=-1)
        first, last = extent[:, 0, None], extent[:, 1, None]
        gap = np.maximum(extent_k[..., 0] - last, first - extent_k[..., 1])
        meets = (length > 0)[:, None] & (length_k > 0) & np.asarray(segment_map.valid)
        if soft:
            cost = e + (np.maximum(gap, 0) / overlap_scale) ** 2
            weights = np.where(meets, np.exp(-cost / 2), 0).sum(1)
            each = np.log(np.exp(-e_max / 2) + weights)
        else:
            e = np.where(meets & (gap < 0), e, np.inf).min(1, initial=np.inf)
            each = -0.5 * np.minimum(e, e_max)
        counts = np.asarray(observed.valid) & (True if used is None else np.asarray(used)[n])
        out.append((each * counts).sum())
    return np.array(out)


def problem(N, M=12, K=60, *, seed=0, spread=(0.2, 0.2, 0.06), at=(0.0, 0.0, 0.4)):
    """A map of random segments, some of them seen with noise from `at`, and a cloud about it."""
    r = np.random.default_rng(seed)
    at = np.array(at)
    middle = at[:2] + r.uniform(-6, 6, (K, 2))
    angle = r.choice([0.0, np.pi / 2, 1.0], K) + r.normal(0, 0.2, K)
    half = r.uniform(0.2, 1.2, (K, 1)) * np.stack([np.cos(angle), np.sin(angle)], 1)
    ends = np.stack([middle - half, middle + half], 1)
    c, s = np.cos(at[2]), np.sin(at[2])
    local = (ends[r.permutation(K)[:M] % K] - at[:2]) @ np.array([[c, -s], [s, c]])
    observed = local + r.normal(0, 0.03, local.shape)
    if len(observed) < M:
        observed = np.concatenate([observed, r.uniform(-4, 4, (M - len(observed), 2, 2))])
    poses = at + r.normal(size=(N, 3)) * spread
    as_segments = lambda a: Segments(jnp.asarray(a, float), jnp.asarray(r.random(len(a)) > 0.1))
    particles = SE2(jnp.asarray(poses[:, :2], float), jnp.asarray(poses[:, 2], float))
    return particles, as_segments(observed), as_segments(ends)


def covariances(M, seed=1):
    r = np.random.default_rng(seed)
    scaled = np.array([0.1, 0.06])[:, None] * r.normal(size=(M, 2, 2))
    return jnp.asarray(scaled @ scaled.transpose(0, 2, 1), float)


def assert_close(got, want, tolerance=1e-4):
    got, want = np.asarray(got, float), np.asarray(want, float)
    assert np.isfinite(got).all()
    assert np.all(np.abs(got - want) <= tolerance * np.maximum(np.abs(want), 1))


# --- the value


@pytest.mark.parametrize("soft", [False, True])
def test_one_pair_by_hand(soft):
    """The robot at (1, 0) looking along y sees the wall x = 3 two metres to its right, 0.3 off."""
    particles = SE2(jnp.array([[1.0, 0.0]]), jnp.array([jnp.pi / 2]))
    wall = Segments(jnp.array([[[3.0, -5.0], [3.0, 5.0]]]), jnp.array([True]))
    seen = Segments(jnp.array([[[1.0, -2.3], [-1.0, -2.3]]]), jnp.array([True]))
    got = log_likelihood(particles, seen, wall, NOISY, soft=soft)
    e = (0.3 / 0.15) ** 2
    assert_close(got, [np.log(np.exp(-4.5) + np.exp(-e / 2)) if soft else -e / 2], 1e-5)


# one M and K for all, so that programs are compiled once
M, K = 12, 60
SIZES = {"few": 9, "listed": 300}


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("N", SIZES.values(), ids=SIZES)
def test_agrees_with_the_reference(N, soft):
    given = problem(N)
    got = log_likelihood(*given, NOISY, soft=soft)
    assert_close(got, reference(*given, *NOISE, soft=soft))


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("N", SIZES.values(), ids=SIZES)
def test_masks_and_covariances_of_each_segment(N, soft):
    given = problem(N, seed=1)
    options = {
        "used": jnp.asarray(np.random.default_rng(2).random((N, M)) > 0.4),
        "covariance": covariances(M),
    }
    got = log_likelihood(*given, LineNoise(0.05, 0.03, 7.0), soft=soft, **options)
    assert_close(got, reference(*given, 0.05, 0.03, 7.0, soft=soft, **options))


@pytest.mark.parametrize("soft", [False, True])
def test_headings_all_around_and_whole_turns(soft):
    """Every name of a line occurs: particles look everywhere, and some have turned many times."""
    particles, observed, segment_map = problem(300, spread=(3.0, 3.0, 2.0))
    turns = 2 * jnp.pi * jnp.asarray(np.random.default_rng(0).integers(-3, 4, 300), float)
    given = SE2(particles.xy, particles.yaw + turns), observed, segment_map
    assert_close(log_likelihood(*given, NOISY, soft=soft), reference(*given, *NOISE, soft=soft))


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("spread", [(0.2, 0.2, 0.06), (5.0, 5.0, 3.0)], ids=["track", "global"])
def test_pruned_is_every_pair(spread, soft):
    given = problem(300, spread=spread)
    every = log_likelihood(*given, NOISY, soft=soft, prune=False)
    pruned, exact = log_likelihood_pruned(*given, NOISY, soft=soft)
    assert bool(exact)
    assert_close(pruned, every, 1e-5)


def test_noise_too_wide_for_the_bounds_is_told_and_evaluated_in_full():
    given = problem(300)
    wide = (0.3, 0.9, 9.0)
    assert not bool(log_likelihood_pruned(*given, LineNoise(*wide))[1])
    assert_close(log_likelihood(*given, LineNoise(*wide)), reference(*given, *wide))


def test_a_new_value_is_not_a_new_program():
    for shift in (0.0, 0.1):
        particles, observed, segment_map = problem(9, seed=int(10 * shift))
        log_likelihood(particles, observed, segment_map, LineNoise(0.1 + shift, 0.1, 9 + shift))
        if shift == 0.0:
            before = _log_likelihood._cache_size()
    assert _log_likelihood._cache_size() == before
    log_likelihood(*problem(10), NOISY)
    assert _log_likelihood._cache_size() == before + 1


def test_a_batch_of_runs_is_one_vmap():
    runs = [problem(100, seed=seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *runs)
    together = jit_quickly(jax.vmap(lambda *run: log_likelihood(*run, NOISY)))(*stacked)
    assert_close(together, [reference(*run, *NOISE) for run in runs])


def test_a_particle_that_is_lost_in_nan_spoils_no_other():
    particles, observed, segment_map = problem(300)
    xy = particles.xy.at[7].set(jnp.nan)
    got = jit_quickly(log_likelihood)(SE2(xy, particles.yaw), observed, segment_map, NOISY)
    want = reference(particles, observed, segment_map, *NOISE)
    others = np.arange(300) != 7
    assert_close(got[others], want[others])


# --- degenerate inputs: right in value, finite in every derivative


# --- memory


def scratch(size, **options):
    """Bytes that the compiled call keeps for itself; nothing is run."""
    N, M, K = size
    segments = lambda n: Segments(jnp.zeros((n, 2, 2)), jnp.ones(n, bool))
    given = SE2(jnp.zeros((N, 2)), jnp.zeros(N)), segments(M), segments(K)

    def call(*given):
        function = lambda *given: log_likelihood(*given, NOISY, **options)
        if options.get("soft"):
            return jax.grad(lambda *given: function(*given).sum())(*given)
        return function(*given)

    return jit_quickly(call).lower(*given).compile().memory_analysis().temp_size_in_bytes


@pytest.mark.parametrize("size", [(300, 30, 100), (10_000, 30, 100), (100_000, 30, 400)])
def test_nothing_of_the_size_of_all_pairs_is_made(size):
    assert scratch(size) < 0.1 * 4 * np.prod(size)


# --- from the image


def make_camera():
    return Camera(jnp.array([[300.0, 0, 320], [0, 300, 240], [0, 0, 1]]), 640, 480)


def image_problem(N):
    r = np.random.default_rng(0)
    mount = Mount.create(0.5, 0.4, x=0.1, roll=0.02, yaw=-0.05)
    pixels = r.uniform([40, 150], [600, 470], (8, 2, 2))
    pixels[0] = [[100, 20], [300, 10]]  # above the horizon
    segments_image = Segments(jnp.asarray(pixels, float), jnp.ones(8, bool))
    on_floor = put_on_floor(make_camera(), mount, segments_image, 8.0)
    poses = r.normal(size=(N, 3)) * [0.1, 0.1, 0.05]
    particles = SE2(jnp.asarray(poses[:, :2], float), jnp.asarray(poses[:, 2], float))
    ends = np.concatenate([np.asarray(on_floor.endpoints)[1:], r.uniform(-4, 4, (193, 2, 2))])
    return mount, particles, segments_image, Segments(jnp.asarray(ends, float), jnp.ones(200, bool))


def test_image_log_likelihood_puts_the_segments_on_the_floor():
    mount, *given = image_problem(20)
    particles, image, segment_map = given
    got = image_log_likelihood(
        make_camera(), mount, particles, image, segment_map, NOISY, soft=True
    )
    on_floor = put_on_floor(make_camera(), mount, image, 8.0)
    assert not bool(on_floor.valid[0])
    assert_close(got, reference(particles, on_floor, segment_map, *NOISE, soft=True))
