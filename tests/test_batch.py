"""The batch functions against a plain float64 reference: random, degenerate, full-size inputs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import jit_quickly

from sofjax.extraction import association_scores, homographies, transferred_lines
from sofjax.extraction.association import Association, association_error
from sofjax.extraction.sof import put_on_floor
from sofjax.geometry import SE2, Camera, Mount, Segments, floor_homography, two_view_homography
from sofjax.geometry.two_view import transfer_segment
from sofjax.likelihood import LineNoise
from sofjax.likelihood.batch import (
    culling,
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


# --- derivatives


STEP = 1e-6  # of the differences


@pytest.fixture
def short_programs(monkeypatch, x64):
    """Groups of two pairs, so that compiling does not take longer than all else; in float64."""
    monkeypatch.setattr(culling, "_group_size", lambda K, prune: 2)


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


def test_nor_for_a_gradient():
    assert scratch((10_000, 30, 400), soft=True) < 0.1 * 4 * 10_000 * 30 * 400


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


@pytest.mark.usefixtures("short_programs")
def test_gradient_by_the_mount_is_the_difference_quotient():
    mount, particles, image, segment_map = image_problem(60)

    def total(at):
        given = particles, image, segment_map
        return image_log_likelihood(make_camera(), at["mount"], *given, NOISY, soft=True).sum()

    assert_derivatives(total, {"mount": mount})


# --- two views


def motions(N):
    r = np.random.default_rng(8)
    xy, yaw = r.normal(0, 0.2, (N, 2)), r.normal(0, 0.2, N)
    return SE2(jnp.asarray(xy, float), jnp.asarray(yaw, float))


@pytest.mark.usefixtures("x64")
def test_homographies_are_those_of_each_motion_and_of_poses():
    camera, mount = make_camera(), Mount.create(0.5, 0.4, x=0.1)
    T = motions(5)
    H = homographies(camera, mount, T)
    floor = floor_homography(camera, mount, SE2.identity())
    for n in range(5):
        one = SE2(T.xy[n], T.yaw[n])
        np.testing.assert_allclose(H[n], two_view_homography(camera, mount, one), rtol=1e-9)
        other = floor_homography(camera, mount, one) @ jnp.linalg.inv(floor)
        same = H[n] / jnp.linalg.norm(H[n]) - other / jnp.linalg.norm(other)
        np.testing.assert_allclose(same, 0, atol=1e-12)  # H = H_F(T') H_F(T)^-1 up to scale
    at = SE2(jnp.array([3.0, -2.0]), jnp.array(1.0))
    np.testing.assert_allclose(homographies(camera, mount, at.between(at @ T)), H, rtol=1e-7)


@pytest.mark.usefixtures("x64")
def test_transferred_lines_pass_through_transferred_points():
    mount, _, image, _ = image_problem(1)
    H = homographies(make_camera(), mount, motions(4))
    lines = transferred_lines(H, image)
    assert lines.shape == (4, 8, 3)
    points = jnp.concatenate([image.endpoints, jnp.ones((8, 2, 1))], axis=-1)
    moved = jnp.einsum("nij,mej->nmei", H, points)
    product = jnp.einsum("nmi,nmei->nme", lines, moved)
    size = jnp.linalg.norm(lines, axis=-1)[..., None] * jnp.linalg.norm(moved, axis=-1)
    assert float(jnp.abs(product / size).max()) < 1e-12
    none = transferred_lines(H, Segments(image.endpoints, jnp.zeros(8, bool)))
    assert not none.any()


def test_association_scores_are_eq_9_of_every_pair():
    config, mount = Association(), Mount.create(0.5, 0.4)
    _, _, first, _ = image_problem(1)
    T = motions(2)
    H = homographies(make_camera(), mount, T)
    moved, _ = jax.vmap(transfer_segment, in_axes=(None, 0))(H[0], first.endpoints[:6])
    second = Segments(moved + 1.0, jnp.array([True] * 5 + [False]))
    scores = association_scores(config, make_camera(), H, first, second)
    assert scores.shape == (2, 8, 6)
    assert jnp.isinf(scores[:, :, 5]).all() and jnp.isfinite(scores).any()
    one = jax.jit(association_error)
    for n, i, j in np.ndindex(2, 8, 5):
        want = one(config, make_camera(), H[n], first.endpoints[i], second.endpoints[j])
        np.testing.assert_allclose(scores[n, i, j], want, rtol=1e-3, atol=1e-2)
