"""Lines followed from image to image, and related over long baselines."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sofjax.calibration.pairs import Estimate, Pairs
from sofjax.extraction.observation import Observation
from sofjax.extraction.sof import below_horizon
from sofjax.geometry.angles import wrap
from sofjax.geometry.camera import Camera
from sofjax.geometry.lines import cofactor, line_point_distance, line_through
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import overlap
from sofjax.geometry.two_view import transfer_segment, two_view_homography


class TrackConfig(eqx.Module):
    """When segments of images that follow one another are one line, and what makes a pair."""

    gate: float = 6.0  # pixels that an end may lie off where the line was to be expected
    turn_gate: float = 0.15  # radians between the directions; a line's two edges point either way
    back: int = eqx.field(static=True, default=3)  # images that a line may be missed, and one
    baseline: float = 0.5  # heights of the camera between the images of a pair at least ...
    longest: float = 2.0  # ... and at most
    min_views: int = 4  # of a line on such a way


def follow(
    rules: TrackConfig, camera: Camera, estimate: Estimate, log: Observation
) -> Int[np.ndarray, "T M"]:
    """A number for every segment, the same for those that follow one another; -1 for none.

    Images that follow one another are so near that a mount wrong by a third still tells where a
    segment went; who is nearest to whom must be mutual. Nothing is followed over a motion that
    the odometer does not tell.
    """
    partners = np.stack([np.asarray(p) for p in _partners(rules, camera, estimate, log)])
    valid = np.asarray(log.segments_image.valid)
    T, M = valid.shape
    track = np.full((T, M), -1)
    sigma = log.motion_sigma
    untold = np.cumsum(np.zeros(T) if sigma is None else np.asarray(sigma > 0).any(-1))
    count = 0
    for t in range(T):
        for lag in range(1, min(rules.back, t) + 1):
            if untold[t] > untold[t - lag]:
                continue
            partner = partners[lag - 1, t]
            take = (track[t] < 0) & (partner >= 0)
            before = np.where(take, track[t - lag][partner], -1)
            # whose line was seen since has gone on already
            before[np.isin(before, track[t - lag + 1 : t + 1])] = -1
            track[t] = np.where(take & (before >= 0), before, track[t])
        new = valid[t] & (track[t] < 0)
        track[t, new] = count + np.arange(new.sum())
        count += new.sum()
    return track


@eqx.filter_jit
def _partners(rules: TrackConfig, camera: Camera, estimate: Estimate, log: Observation):
    """[T, M] for each lag: the segment so many images before that is the same line, or -1."""
    poses = path(jax.vmap(estimate.motion)(log.motion))
    floor = jax.vmap(below_horizon, in_axes=(None, None, 0))(
        camera, estimate.mount, log.segments_image
    )
    index = jnp.arange(poses.yaw.shape[0])

    def at(lag):
        def one(t):
            before = jnp.maximum(t - lag, 0)
            at = lambda tree, i: jax.tree.map(lambda x: x[i], tree)
            a, b = at(floor, before), at(floor, t)
            T = at(poses, before).between(at(poses, t))
            H = two_view_homography(camera, estimate.mount, T)
            of_pair = lambda x, y: miss(rules, H, x, y)
            off = jax.vmap(lambda y: jax.vmap(lambda x: of_pair(x, y))(a.endpoints))(b.endpoints)
            off = jnp.where(a.valid[None] & b.valid[:, None] & (t >= lag), off, jnp.inf)
            best = off.argmin(axis=1)
            mutual = off.argmin(axis=0)[best] == jnp.arange(len(best))
            return jnp.where(mutual & (off.min(axis=1) < rules.gate), best, -1)

        return jax.lax.map(one, index, batch_size=16)

    return [at(lag) for lag in range(1, rules.back + 1)]


def miss(
    rules: TrackConfig, H: Float[Array, "3 3"], first: Float[Array, "2 2"],
    second: Float[Array, "2 2"],
) -> Float[Array, ""]:  # fmt: skip
    """How far the second's ends lie from where the first was to go, pixels; inf if another line."""
    moved, ahead = transfer_segment(H, first)
    line = cofactor(H) @ line_through(*first)
    off = jnp.abs(jax.vmap(line_point_distance, in_axes=(None, 0))(line, second)).max()
    angle = lambda s: jnp.arctan2(s[1, 1] - s[0, 1], s[1, 0] - s[0, 0])
    turn = jnp.abs(wrap(angle(moved) - angle(second)))
    same = ahead & (turn < rules.turn_gate) & (overlap(moved, second) > 0)
    return jnp.where(same, off, jnp.inf)


@jax.jit
def path(motion: SE2) -> SE2:
    """Poses [T] after motions [T], the first of which does not count."""

    def step(T, moved):
        T = T @ moved
        return T, T

    return jax.lax.scan(step, jax.tree.map(lambda x: jnp.zeros_like(x[0]), motion), motion)[1]


def relate(
    rules: TrackConfig,
    log: Observation,
    track: Int[np.ndarray, "T M"],
    height: float,
    capacity: int,
) -> tuple[Pairs, Int[Array, "N"]]:
    """Pairs of one line's views: the first with the last, the second with the last but one, ...

    So every segment is used once, the errors of a line's pairs are independent, and all of them
    together say of a motion what all the views say. What is followed for longer than `longest` is
    cut into parts.

    **Arguments:**
    - `height`: of the camera, metres, roughly.
    - `capacity`: N; if there are more pairs, they are thinned out evenly.

    **Returns:** pairs with unit sigmas, those of one stretch of the way a cluster; and the number
    of each pair's line, from 0 to N - 1, and -1 where there is none.
    """
    endpoints = np.asarray(log.segments_image.endpoints, float)
    poses = jax.device_get(path(log.motion))
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses.xy, axis=0), axis=1))])
    way /= height
    t, m = np.nonzero(track >= 0)
    order = np.argsort(track[t, m], kind="stable")
    t, m = t[order], m[order]
    begins = np.flatnonzero(np.diff(track[t, m], prepend=-1))
    chosen = []
    for begin, end in zip(begins, [*begins[1:], len(t)], strict=True):
        length = way[t[end - 1]] - way[t[begin]]
        if end - begin < rules.min_views or length < rules.baseline:
            continue
        parts = int(np.ceil(length / rules.longest))
        cut = ((way[t[begin:end]] - way[t[begin]]) / length * parts).astype(int)
        edges = begin + np.searchsorted(np.minimum(cut, parts - 1), np.arange(parts + 1))
        for low, high in itertools.pairwise(edges):
            a = np.arange(low, (low + high) // 2)
            b = high - 1 - (a - low)
            far = way[t[b]] - way[t[a]] >= rules.baseline
            chosen.append(np.stack([a, b], axis=1)[far])
    chosen = np.concatenate(chosen) if chosen else np.zeros((0, 2), int)
    if len(chosen) > capacity:
        chosen = chosen[np.linspace(0, len(chosen) - 1, capacity).round().astype(int)]
    a, b = chosen.T
    line = np.unique(track[t[a], m[a]], return_inverse=True)[1]

    def pad(rows, fill=0):
        empty = np.full((capacity - len(chosen), *rows.shape[1:]), fill, rows.dtype)
        return jnp.asarray(np.concatenate([rows, empty]))

    at = lambda i: SE2(jnp.asarray(poses.xy[t[i]], float), jnp.asarray(poses.yaw[t[i]], float))
    pairs = Pairs(
        first=pad(endpoints[t[a], m[a]]),
        second=pad(endpoints[t[b], m[b]]),
        T_first_second=jax.tree.map(lambda x: pad(np.asarray(x)), at(a).between(at(b))),
        valid=jnp.arange(capacity) < len(chosen),
        sigma=jnp.ones((capacity, 4)),
        cluster=pad(_stretches(way[t[a]], way[-1], rules.longest)),
    )
    return pairs, pad(line, -1)


def _stretches(at: Float[np.ndarray, "N"], whole: float, length: float) -> Int[np.ndarray, "N"]:
    """Which stretch of the way each place is in: `length` long, and ten at least."""
    length = max(min(length, whole / 10), 1e-9)
    return np.unique((at / length).astype(int), return_inverse=True)[1]
