"""Lines followed from image to image, and related over long baselines."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sofjax._checks import check_fields
from sofjax.calibration.pairs import Estimate, SegmentPairs
from sofjax.extraction.observation import Observation
from sofjax.extraction.sof import below_horizon
from sofjax.geometry.angles import wrap
from sofjax.geometry.lines import cofactor, line_point_distance, line_through
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import overlap
from sofjax.geometry.two_view import transfer_segment, two_view_homography
from sofjax.rig import corrected


class TrackConfig(eqx.Module):
    """When segments of successive images are one line, and which of them make a pair."""

    gate: float = 6.0  # pixels, the largest distance of an end from the predicted line
    turn_gate: float = 0.15  # radians between directions; a line's two edges have opposite ones
    max_lag: int = eqx.field(static=True, default=3)  # images back that a line is searched in
    min_baseline: float = 0.5  # smallest distance between the images of a pair, camera heights
    max_baseline: float = 2.0  # and the largest
    min_views: int = 4  # views of a line within the largest distance

    def __check_init__(self) -> None:
        check_fields(
            self,
            positive=("gate", "turn_gate", "min_baseline", "max_baseline"),
            whole_from={"max_lag": 1, "min_views": 2},
        )


def follow(config: TrackConfig, estimate: Estimate, log: Observation) -> Int[np.ndarray, "T M"]:
    """A number for every segment, the same for all segments of one line; -1 for none.

    Successive images are so near that a mount wrong by a third still predicts where a segment
    went. Two segments are one line only if each is the nearest of the other. Nothing is followed
    over a motion that the odometer did not read.
    """
    partners = np.stack([np.asarray(p) for p in _partners(config, estimate, log)])
    valid = np.asarray(log.segments_image.valid)
    T, M = valid.shape
    track = np.full((T, M), -1)
    sigma = log.motion_sigma
    unread = np.cumsum(np.zeros(T) if sigma is None else np.asarray(sigma > 0).any(-1))
    count = 0
    for t in range(T):
        for lag in range(1, min(config.max_lag, t) + 1):
            if unread[t] > unread[t - lag]:
                continue
            partner = partners[lag - 1, t]
            take = (track[t] < 0) & (partner >= 0)
            before = np.where(take, track[t - lag][partner], -1)
            # a line that was seen since then continues from there
            before[np.isin(before, track[t - lag + 1 : t + 1])] = -1
            track[t] = np.where(take & (before >= 0), before, track[t])
        new = valid[t] & (track[t] < 0)
        track[t, new] = count + np.arange(new.sum())
        count += new.sum()
    return track


@eqx.filter_jit
def _partners(config: TrackConfig, estimate: Estimate, log: Observation) -> list[Int[Array, "T M"]]:
    """[T, M] for each lag: the segment so many images before that is the same line, or -1."""
    rig = estimate.rig
    log = corrected(estimate.given, rig, log)
    poses = path(jax.vmap(estimate.motion)(log.motion))
    floor = jax.vmap(below_horizon, in_axes=(None, None, 0))(
        rig.camera, rig.mount, log.segments_image
    )
    index = jnp.arange(poses.yaw.shape[0])

    def at(lag: int) -> Int[Array, "T M"]:
        def one(t: Int[Array, ""]) -> Int[Array, "M"]:
            before = jnp.maximum(t - lag, 0)
            at = lambda tree, i: jax.tree.map(lambda x: x[i], tree)
            a, b = at(floor, before), at(floor, t)
            T = at(poses, before).between(at(poses, t))
            H = two_view_homography(rig.camera, rig.mount, T)
            of_pair = lambda x, y: transfer_error(config, H, x, y)
            off = jax.vmap(lambda y: jax.vmap(lambda x: of_pair(x, y))(a.endpoints))(b.endpoints)
            off = jnp.where(a.valid[None] & b.valid[:, None] & (t >= lag), off, jnp.inf)
            best = off.argmin(axis=1)
            mutual = off.argmin(axis=0)[best] == jnp.arange(len(best))
            return jnp.where(mutual & (off.min(axis=1) < config.gate), best, -1)

        return jax.lax.map(one, index, batch_size=16)

    return [at(lag) for lag in range(1, config.max_lag + 1)]


def transfer_error(
    config: TrackConfig, H: Float[Array, "3 3"], first: Float[Array, "2 2"],
    second: Float[Array, "2 2"],
) -> Float[Array, ""]:  # fmt: skip
    """Largest distance of an end of `second` from the transferred `first`, pixels.

    Infinite if the two cannot be one line.
    """
    moved, ahead = transfer_segment(H, first)
    line = cofactor(H) @ line_through(*first)
    off = jnp.abs(jax.vmap(line_point_distance, in_axes=(None, 0))(line, second)).max()
    angle = lambda s: jnp.arctan2(s[1, 1] - s[0, 1], s[1, 0] - s[0, 0])
    turn = jnp.abs(wrap(angle(moved) - angle(second)))
    same = ahead & (turn < config.turn_gate) & (overlap(moved, second) > 0)
    return jnp.where(same, off, jnp.inf)


@jax.jit
def path(motion: SE2) -> SE2:
    """Poses [T] after motions [T]; the first motion is not used."""

    def step(T: SE2, moved: SE2) -> tuple[SE2, SE2]:
        T = T @ moved
        return T, T

    return jax.lax.scan(step, jax.tree.map(lambda x: jnp.zeros_like(x[0]), motion), motion)[1]


def relate(
    config: TrackConfig,
    log: Observation,
    track: Int[np.ndarray, "T M"],
    height: float,
    capacity: int,
) -> tuple[SegmentPairs, Int[Array, "N"]]:
    """Pairs of one line's views: the first with the last, the second with the last but one, ...

    So every segment is used once and the errors of a line's pairs are independent. A line that is
    followed for longer than `max_baseline` is cut into parts.

    **Arguments:**
    - `height`: of the camera, metres, roughly.
    - `capacity`: N; if there are more pairs, they are thinned out evenly.

    **Returns:** pairs with unit sigmas, those of one stretch of the path in one cluster; and the
    number of each pair's line, from 0 to N - 1, and -1 where there is none.
    """
    endpoints = np.asarray(log.segments_image.endpoints, float)
    poses = jax.device_get(path(log.motion))
    travelled = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(poses.xy, axis=0), axis=1))]
    )
    travelled /= height
    t, m = np.nonzero(track >= 0)
    order = np.argsort(track[t, m], kind="stable")
    t, m = t[order], m[order]
    begins = np.flatnonzero(np.diff(track[t, m], prepend=-1))
    chosen = []
    for begin, end in zip(begins, [*begins[1:], len(t)], strict=True):
        length = travelled[t[end - 1]] - travelled[t[begin]]
        if end - begin < config.min_views or length < config.min_baseline:
            continue
        parts = int(np.ceil(length / config.max_baseline))
        cut = ((travelled[t[begin:end]] - travelled[t[begin]]) / length * parts).astype(int)
        edges = begin + np.searchsorted(np.minimum(cut, parts - 1), np.arange(parts + 1))
        for low, high in itertools.pairwise(edges):
            a = np.arange(low, (low + high) // 2)
            b = high - 1 - (a - low)
            far = travelled[t[b]] - travelled[t[a]] >= config.min_baseline
            chosen.append(np.stack([a, b], axis=1)[far])
    chosen = np.concatenate(chosen) if chosen else np.zeros((0, 2), int)
    if len(chosen) > capacity:
        chosen = chosen[np.linspace(0, len(chosen) - 1, capacity).round().astype(int)]
    a, b = chosen.T
    line = np.unique(track[t[a], m[a]], return_inverse=True)[1]

    def pad(rows: np.ndarray, fill: int = 0) -> Array:
        empty = np.full((capacity - len(chosen), *rows.shape[1:]), fill, rows.dtype)
        return jnp.asarray(np.concatenate([rows, empty]))

    around = None if log.around is None else np.asarray(log.around, float)
    at = lambda i: SE2(jnp.asarray(poses.xy[t[i]], float), jnp.asarray(poses.yaw[t[i]], float))
    pairs = SegmentPairs(
        first=pad(endpoints[t[a], m[a]]),
        second=pad(endpoints[t[b], m[b]]),
        T_first_second=jax.tree.map(lambda x: pad(np.asarray(x)), at(a).between(at(b))),
        valid=jnp.arange(capacity) < len(chosen),
        sigma=jnp.ones((capacity, 4)),
        cluster=pad(_stretches(travelled[t[a]], travelled[-1], config.max_baseline)),
        around=None if around is None else (pad(around[t[a]]), pad(around[t[b]])),
    )
    return pairs, pad(line, -1)


def _stretches(at: Float[np.ndarray, "N"], whole: float, length: float) -> Int[np.ndarray, "N"]:
    """Which stretch of the path each place is in: `length` long, and at least ten stretches."""
    length = max(min(length, whole / 10), 1e-9)
    return np.unique((at / length).astype(int), return_inverse=True)[1]
