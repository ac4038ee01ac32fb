"""Problems, and every form in which the likelihood of many particles can be evaluated."""

import time

import jax
import jax.numpy as jnp
import numpy as np

import sofjax
from sofjax import LineNoise
from sofjax.geometry import (
    SE2,
    Camera,
    Mount,
    Segments,
    floor_homography,
    floor_to_image,
    overlap,
    polar_difference,
    polar_through,
)

TRACKING, ANYWHERE = "track", "anywhere"


def make_problem(N: int, M: int, K: int, cloud: str, seed: int = 0) -> dict:
    """A loop of corridors of 11.5 m by 24 m with segments along and across it."""
    r = np.random.default_rng([seed, N, M, K])
    around = r.uniform(0, 71, K)
    corner = np.array([0, 24, 35.5, 59.5])
    side = np.searchsorted(corner, around, side="right") - 1
    heading = np.pi / 2 * (1 - side)
    start = np.array([[0, 0], [0, 24], [11.5, 24], [11.5, 0]], float)[side]
    unit = lambda a: np.stack([np.cos(a), np.sin(a)], -1)
    middle = start + (around - corner[side])[:, None] * unit(heading)
    middle += r.uniform(-1, 1, (K, 1)) * unit(heading + np.pi / 2)
    angle = heading + np.pi / 2 * r.integers(0, 2, K) + r.normal(0, 0.03, K)
    half = r.uniform(0.15, 1.1, (K, 1)) * unit(angle)
    lines = np.stack([middle - half, middle + half], 1)

    pose = np.array([0.1, 6.0, np.pi / 2 + 0.05])
    local = (lines - pose[:2]) @ np.stack([unit(pose[2]), unit(pose[2] + np.pi / 2)], 1)
    ahead = local[:, :, 0].min(axis=1) > 0.3
    near = np.argsort(np.where(ahead, np.hypot(*local.mean(1).T), np.inf), kind="stable")
    seen = local[near[np.arange(M) % max(min(M, int(ahead.sum())), 1)]]
    seen = seen + r.normal(0, 0.03, (M, 2, 2))
    if cloud == TRACKING:
        particles = pose + r.normal(0, 1, (N, 3)) * [0.25, 0.25, 0.06]
    else:
        particles = r.uniform([-1, -1, -np.pi], [12.5, 25, np.pi], (N, 3))
    return {
        "particles": particles.astype(np.float32),
        "observed": seen.reshape(M, 4).astype(np.float32),
        "map": lines.reshape(K, 4).astype(np.float32),
        "observed_valid": r.random(M) > 0.07,
        "map_valid": r.random(K) > 0.07,
        "sigma_rho": np.float32(0.15),
        "sigma_theta": np.float32(0.08),
        "e_max": np.float32(9),
    }


def arguments(problem: dict) -> tuple[SE2, Segments, Segments, LineNoise]:
    """What `sofjax.log_likelihood` takes."""
    noise = ("sigma_rho", "sigma_theta", "e_max")
    xyt = jnp.asarray(problem["particles"], jnp.float32)
    segments = lambda ends, valid: Segments(
        jnp.asarray(problem[ends], jnp.float32).reshape(-1, 2, 2), jnp.asarray(problem[valid])
    )
    return (
        SE2(xyt[:, :2], xyt[:, 2]),
        segments("observed", "observed_valid"),
        segments("map", "map_valid"),
        LineNoise(*(jnp.asarray(problem[name], jnp.float32) for name in noise)),
    )


def naive(particles: SE2, observed: Segments, segment_map: Segments, noise: LineNoise) -> jax.Array:
    """The definition for one pair, under three vmaps."""

    def pair(
        pose: SE2, seen: jax.Array, seen_valid: jax.Array, line: jax.Array, line_valid: jax.Array
    ) -> jax.Array:
        moved = pose.inverse().apply(line)
        d = polar_difference(polar_through(seen), polar_through(moved))
        e = (d[0] / noise.rho_sigma) ** 2 + (d[1] / noise.theta_sigma) ** 2
        return jnp.where((overlap(moved, seen) > 0) & line_valid & seen_valid, e, jnp.inf)

    over_map = jax.vmap(pair, in_axes=(None, None, None, 0, 0))
    over_seen = jax.vmap(over_map, in_axes=(None, 0, 0, None, None))
    e = jax.vmap(over_seen, in_axes=(0, None, None, None, None))(
        particles, observed.endpoints, observed.valid, segment_map.endpoints, segment_map.valid
    )
    cost = jnp.minimum(e.min(axis=-1), noise.e_max)
    return -0.5 * jnp.where(observed.valid, cost, 0).sum(axis=-1)


def in_numpy(problem: dict, chunk: int = 25) -> np.ndarray:
    """Broadcasting over [n, M, K] for chunks of particles that stay in the cache."""
    (x1, y1), (x2, y2) = problem["map"][problem["map_valid"]].reshape(-1, 2, 2).transpose(1, 2, 0)
    (u1, v1), (u2, v2) = problem["observed"].reshape(-1, 2, 2).transpose(1, 2, 0)
    sigma_rho, sigma_theta, e_max = problem["sigma_rho"], problem["sigma_theta"], problem["e_max"]
    theta = np.arctan2(v2 - v1, u2 - u1)[:, None]
    cos, sin = np.cos(theta), np.sin(theta)
    rho = cos * v1[:, None] - sin * u1[:, None]
    first, second = (cos[:, 0] * u + sin[:, 0] * v for u, v in ((u1, v1), (u2, v2)))
    low, high = np.minimum(first, second)[:, None], np.maximum(first, second)[:, None]
    phi = np.arctan2(y2 - y1, x2 - x1)
    pi = np.float32(np.pi)

    def some(x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> np.ndarray:
        c, s = np.cos(yaw), np.sin(yaw)
        moved = lambda X, Y: (c * (X - x) + s * (Y - y), c * (Y - y) - s * (X - x))
        a, b = moved(x1, y1), moved(x2, y2)  # [n, 1, K]
        turn = (phi - yaw) - theta
        half_turns = np.rint(turn / pi)
        side = 1 - 2 * np.abs(half_turns - 2 * np.rint(half_turns / 2))
        r = np.cos(phi - yaw) * a[1] - np.sin(phi - yaw) * a[0]
        e = ((r - side * rho) / sigma_rho) ** 2 + ((turn - pi * half_turns) / sigma_theta) ** 2
        p, q = cos * a[0] + sin * a[1], cos * b[0] + sin * b[1]
        e[(np.maximum(p, q) <= low) | (np.minimum(p, q) >= high)] = np.inf
        return -0.5 * np.minimum(e.min(-1, initial=e_max), e_max) @ problem["observed_valid"]

    parts = np.array_split(problem["particles"], max(1, len(problem["particles"]) // chunk))
    return np.concatenate([some(*part.T[:, :, None, None]) for part in parts])


def by_pose(*arguments: object) -> tuple[jax.Array, SE2]:
    """Value and gradient of each particle's own likelihood."""
    total = lambda particles: (
        lambda values: (values.sum(), values)
    )(sofjax.log_likelihood(particles, *arguments[1:], soft=True))  # fmt: skip
    gradient, values = jax.grad(total, has_aux=True)(arguments[0])
    return values, gradient


def of_image(
    height_pitch: jax.Array,
    camera: Camera,
    mount: Mount,
    segments_image: Segments,
    particles: SE2,
    segment_map: Segments,
    noise: LineNoise,
) -> jax.Array:
    """The soft form as a function of the mount."""
    mount = Mount(mount.x, mount.y, *height_pitch, mount.roll, mount.yaw)
    return sofjax.image_log_likelihood(
        camera, mount, particles, segments_image, segment_map, noise, max_depth=30.0, soft=True
    )


def by_mount(height_pitch: jax.Array, *arguments: object) -> tuple[jax.Array, jax.Array]:
    """The same with both derivatives for each particle."""
    values, push = jax.linearize(lambda at: of_image(at, *arguments), height_pitch)
    return values, jax.vmap(push)(jnp.eye(2))


def forms(problem: dict) -> dict:
    """Compiled functions without arguments, and their scratch memory and compile time."""
    given = arguments(problem)
    camera = Camera(jnp.array([[270.0, 0, 159.5], [0, 270, 119.5], [0, 0, 1]]), 320, 240)
    mount = Mount(*(jnp.asarray(v) for v in (0.05, 0.0, 0.6, 0.26, 0.0, 0.0)))
    H_F = floor_homography(camera, mount, SE2.identity())
    pixels, ahead = jax.vmap(jax.vmap(floor_to_image, in_axes=(None, 0)), in_axes=(None, 0))(
        H_F, given[1].endpoints
    )
    segments_image = Segments(pixels, given[1].valid & ahead.all(axis=1))
    particles, _, *rest = given
    at = jnp.stack([mount.height, mount.pitch])
    image = (at, camera, mount, segments_image, particles, *rest)
    library = lambda **how: lambda *a: sofjax.log_likelihood(*a, **how)
    jitted = {
        "library": (library(), given),
        "every pair": (library(prune=False), given),
        "pruned": (lambda *a: sofjax.log_likelihood_pruned(*a)[0], given),
        "soft": (library(soft=True), given),
        "soft, every pair": (library(soft=True, prune=False), given),
        "soft + pose gradient": (by_pose, given),
        "soft of the image": (of_image, image),
        "soft of the image + gradient in (height, pitch)": (by_mount, image),
    }
    if np.prod([len(a) for a in (problem["particles"], problem["observed"], problem["map"])]) < 2e8:
        jitted["naive triple vmap"] = (naive, given)
    made = {"chunked numpy": (lambda: in_numpy(problem), 0, 0.0)}
    for name, (function, inputs) in jitted.items():
        start = time.perf_counter()
        compiled = jax.jit(function).lower(*inputs).compile()
        seconds = time.perf_counter() - start
        scratch = compiled.memory_analysis().temp_size_in_bytes
        call = lambda compiled=compiled, inputs=inputs: jax.block_until_ready(compiled(*inputs))
        made[name] = (call, scratch, seconds)
    return made
