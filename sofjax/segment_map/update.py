"""How the map grows: eq. (14), extend-only, R, L and rest, merging doubled lines; III.B."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax._pytree import in_any_run
from sofjax.geometry.angles import safe_norm
from sofjax.geometry.lines import (
    PolarLine,
    alignment,
    polar_difference,
    polar_through,
    rename_covariance,
)
from sofjax.geometry.matrices import inverse_2x2
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments, overlap, unit
from sofjax.likelihood.measurements import Measurements
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.segment_map.classify import is_off_floor, posterior_given_class
from sofjax.segment_map.extents import spanned, together_at, within
from sofjax.segment_map.local_map import predict_measurement
from sofjax.segment_map.types import MapConfig, SegmentMap

JITTER_LEFT = 0.1  # share of the jitter's variance that remains when it has been solved for


class Observed(eqx.Module):
    """An image's M measurements, and what each of them is to the map."""

    measurements: Measurements
    jitter: Float[Array, "2"]  # attitude jitter (pitch, roll) to correct them for, radians
    T_world_nadir: SE2  # the chosen pose
    near: Int[Array, "L"]  # slots of the lines that the image may show; the others only age
    in_view: Bool[Array, "L"]  # which of them it should show
    at: Int[Array, "M"]  # which of them each measurement is, ...
    known: Bool[Array, "M"]  # ... if it is one
    like: Int[Array, "M C"]  # its most similar lines: the same line may stand there once more
    new: Bool[Array, "M"]  # it begins a line


def integrate(
    config: MapConfig, sensor: SensorModel, segment_map: SegmentMap, observed: Observed
) -> tuple[SegmentMap, Int[Array, ""], Int[Array, "M"]]:
    """Step 6 of Fig. 6: an observed segment updates the known line `near[at]` or begins a new one.

    **Returns:** the map; how many new lines found no free slot; and the slot of each, K for none.
    """
    near, at = observed.near, observed.at
    K, L = segment_map.updates.shape[0], near.shape[0]
    slot = jnp.where(observed.known, near[at], K)
    resting = segment_map.resting.at[slot].get(mode="clip") > 0
    moving = jnp.where(observed.known & ~resting, slot, K)
    in_view = observed.in_view.at[jnp.where(moving < K, at, L)].set(True, mode="drop")
    segment_map = _age(segment_map, near, in_view, observed.measurements)
    segment_map = _update(config, sensor, segment_map, observed, moving)
    segment_map = _merge(config, segment_map, slot, near[observed.like.T])
    segment_map, overflow, slot = _insert(config, segment_map, observed)
    return _forget(config, segment_map), overflow, slot


def _age(
    m: SegmentMap,
    near: Int[Array, "L"],
    in_view: Bool[Array, "L"],
    measurements: Measurements,
) -> SegmentMap:
    """An image has passed, in which some lines should have been; one without segments is none."""
    passed = measurements.valid.any().astype(int)
    return eqx.tree_at(
        lambda m: (m.resting, m.unseen, m.expected), m,
        (jnp.maximum(m.resting - passed, 0), m.unseen + passed,
         m.expected.at[near].add(passed * (in_view & m.valid[near]).astype(int), mode="drop")),
    )  # fmt: skip


Line = tuple[
    Float[Array, "M 3"], Float[Array, "M 3 3"], SE2
]  # (rho, theta, scale), covariance, anchor


class _Measurement(eqx.Module):
    """One image's measurement of each line: pieces of one line count as one."""

    innovation: Float[Array, "M 2"]  # (rho, theta) observed less expected, in the present nadir
    precision: Float[Array, "M 2 2"]
    covariance: Float[Array, "M 2 2"]  # its inverse
    expected: Float[Array, "M 3"]  # the line (rho, theta, apparent scale) as predicted from there
    H: Float[Array, "M 2 3"]  # d(rho, theta) / d(line)


def _measure(
    config: MapConfig,
    sensor: SensorModel,
    m: SegmentMap,
    image: Observed,
    together: Bool[Array, "M M"],
) -> _Measurement:
    M, measurements = m.updates.shape[0], image.measurements
    expected, H = jax.vmap(predict_measurement, in_axes=(0, 0, None))(
        m.line, m.anchor, image.T_world_nadir
    )
    # by the map line's name: a measurement may be named from the other side
    line = PolarLine(expected[:, 0], expected[:, 1])
    observed = measurements.without_jitter(image.jitter)
    innovation = -polar_difference(line, observed)
    drift = jnp.diag(jnp.array([config.rho_drift, config.theta_drift]) ** 2)
    jitter = (
        sensor.tilt_sigma**2 * measurements.by_jitter @ jnp.swapaxes(measurements.by_jitter, 1, 2)
    )
    noise = rename_covariance(
        measurements.covariance + JITTER_LEFT * jitter, alignment(line, observed)
    )
    precision = inverse_2x2(noise + drift)
    each = jnp.concatenate([precision.reshape(M, 4), _times(precision, innovation)], axis=1)
    moves = together.any(axis=0)[:, None]  # the others are padding, and not even zero times it
    each = jnp.where(moves, each, 0)
    total = jnp.matmul(together.astype(float), each, precision=jax.lax.Precision.HIGHEST)
    precision = jnp.where(moves[..., None], total[:, :4].reshape(M, 2, 2), jnp.eye(2))
    covariance = inverse_2x2(precision)
    return _Measurement(_times(covariance, total[:, 4:]), precision, covariance, expected, H)


def _times(matrix: Float[Array, "M i j"], vector: Float[Array, "M j"]) -> Float[Array, "M i"]:
    return (matrix @ vector[..., None])[..., 0]


def _running_mean(m: SegmentMap, seen: _Measurement, T_world_nadir: SE2) -> Line:
    """Eq. (14), in the polar form about the present nadir: rho <- rho gamma + rho' (1 - gamma)."""
    M = m.updates.shape[0]
    gamma = m.updates / (1 + m.updates)
    polar = seen.expected[:, :2] + (1 - gamma)[:, None] * seen.innovation
    line = jnp.concatenate([polar, jnp.ones((M, 1))], axis=1)
    here = SE2(
        jnp.broadcast_to(T_world_nadir.xy, (M, 2)), jnp.broadcast_to(T_world_nadir.yaw, (M,))
    )
    return line, m.covariance, here


def _kalman(m: SegmentMap, seen: _Measurement, T_world_nadir: SE2) -> Line:
    """Kalman update in the anchor frame, with the apparent scale; Joseph form."""
    transpose = lambda a: jnp.swapaxes(a, 1, 2)
    PHt = m.covariance @ transpose(seen.H)
    W = seen.precision
    gain = PHt @ W @ inverse_2x2(jnp.eye(2) + seen.H @ PHt @ W)
    rest = jnp.eye(3) - gain @ seen.H
    covariance = rest @ m.covariance @ transpose(rest) + gain @ seen.covariance @ transpose(gain)
    return m.line + _times(gain, seen.innovation), covariance, m.anchor


def _update(
    config: MapConfig,
    sensor: SensorModel,
    segment_map: SegmentMap,
    image: Observed,
    slot: Int[Array, "M"],
) -> SegmentMap:
    """The known lines move by the rule, and their extents only ever grow."""
    K = segment_map.updates.shape[0]
    together = together_at(slot, K)
    m = segment_map.take(slot)  # [M]
    seen = _measure(config, sensor, m, image, together)
    rule = _running_mean if config.rule == "gamma" else _kalman
    line, covariance, anchor = rule(m, seen, image.T_world_nadir)
    now = eqx.tree_at(lambda m: (m.line, m.covariance, m.anchor), m, (line, covariance, anchor))
    endpoints = _extend(config, now, image, together)
    grown = (safe_norm(endpoints[:, 1] - endpoints[:, 0]) > config.length) & (
        m.segments_world.length <= config.length
    )
    moved = SegmentMap(
        segments_world=Segments(endpoints, m.valid),
        anchor=anchor,
        line=line,
        covariance=covariance,
        updates=m.updates + 1,
        resting=jnp.where(grown, config.rest, m.resting),
        unseen=jnp.zeros_like(m.unseen),
        expected=m.expected,
    )
    order = jnp.arange(slot.shape[0])
    again = (together & (order[:, None] < order)).any(axis=0)  # the first piece stands for all
    return segment_map.put(jnp.where(again, K, slot), moved)


def _extend(
    config: MapConfig, m: SegmentMap, image: Observed, together: Bool[Array, "M M"]
) -> Float[Array, "M 2 2"]:
    """End points on the updated lines, grown by what was seen within R, never shrunk."""
    anchor = m.anchor
    line, _ = jax.vmap(posterior_given_class, in_axes=(None, 0, 0))(config, m.line, m.covariance)
    polar = PolarLine(line[:, 0] / line[:, 2], line[:, 1])  # where it is, not where it appears
    T_anchor_world = anchor.inverse()
    old = jax.vmap(SE2.apply)(T_anchor_world, m.segments_world.endpoints)

    ends = image.measurements.endpoints_nadir
    near, some = jax.vmap(within, in_axes=(0, None))(ends, config.range)
    T_anchor_nadir = jax.vmap(lambda T: T @ image.T_world_nadir)(T_anchor_world)
    points = jax.vmap(SE2.apply)(T_anchor_nadir, near / line[:, 2, None, None])
    return jax.vmap(SE2.apply)(anchor, spanned(polar, old, points, together & some[:, None]))


def _insert(
    config: MapConfig, m: SegmentMap, image: Observed
) -> tuple[SegmentMap, Int[Array, ""], Int[Array, "M"]]:
    measurements, T_world_nadir = image.measurements, image.T_world_nadir
    K, M = config.capacity, image.new.shape[0]
    near, some = jax.vmap(within, in_axes=(0, None))(measurements.endpoints_nadir, config.range)
    new = image.new & some
    free = jnp.nonzero(~m.valid, size=M, fill_value=K)[0]
    slot = jnp.where(new, free[jnp.cumsum(new) - 1], K)
    observed = measurements.without_jitter(image.jitter)
    line = jnp.stack([observed.rho, observed.theta, jnp.ones(M)], axis=1)
    covariance = jnp.zeros((M, 3, 3)).at[:, :2, :2].set(measurements.covariance)
    covariance = covariance.at[:, 2, 2].set(config.scale_sigma**2)
    put = lambda a, b: a.at[slot].set(b, mode="drop")
    overflow = jnp.sum(new & (slot == K))
    grown = SegmentMap(
        segments_world=Segments(
            put(m.segments_world.endpoints, T_world_nadir.apply(near)), put(m.valid, True)
        ),
        anchor=SE2(put(m.anchor.xy, T_world_nadir.xy), put(m.anchor.yaw, T_world_nadir.yaw)),
        line=put(m.line, line),
        covariance=put(m.covariance, covariance),
        updates=put(m.updates, 1),
        resting=put(m.resting, 0),
        unseen=put(m.unseen, 0),
        expected=put(m.expected, 1),
    )
    return grown, overflow, slot


def _merge(
    config: MapConfig, m: SegmentMap, slot: Int[Array, "M"], like: Int[Array, "C M"]
) -> SegmentMap:
    """A line just seen that duplicates an older one is merged into it: its place, both extents.

    **Arguments:**
    - `slot`: the lines just seen, K for none.
    - `like`: what each may duplicate.
    """
    K = m.updates.shape[0]
    get = lambda leaf, slot: leaf.at[slot].get(mode="fill", fill_value=0)
    off_floor = lambda slot: is_off_floor(config, get(m.line, slot), get(m.covariance, slot))
    mine, ends = get(m.segments_world.endpoints, slot), get(m.segments_world.endpoints, like)
    # by unit vectors: angles of all pairs would take most of the time
    d, d_like = unit(mine), unit(ends)
    cos = d[:, 0] * d_like[..., 0] + d[:, 1] * d_like[..., 1]
    off = lambda x: jnp.abs(
        (x[:, 1] - ends[..., 0, 1]) * d_like[..., 0] - (x[:, 0] - ends[..., 0, 0]) * d_like[..., 1]
    )
    updates, updates_like = get(m.updates, slot), get(m.updates, like)
    duplicate = (
        (jnp.maximum(off(mine[:, 0]), off(mine[:, 1])) < config.merge_distance)
        & ((cos if config.directed else jnp.abs(cos)) > jnp.cos(config.merge_angle))
        & (-overlap(mine, ends) < config.join_gap)
        & (off_floor(like) == off_floor(slot))
        & ((updates_like > updates) | ((updates_like == updates) & (like < slot)))  # older
        & get(m.valid, like)
        & get(m.valid, slot)
    )

    def joined() -> Segments:
        into = jnp.where(duplicate, like, K).min(axis=0)  # the first of them
        dying = jnp.zeros(K, bool).at[slot].max(into < K, mode="drop")
        into = jnp.where(get(dying, into), K, into)
        old = get(m.segments_world.endpoints, into)
        whole = spanned(jax.vmap(polar_through)(old), old, mine, together_at(into, K))
        return Segments(
            m.segments_world.endpoints.at[into].set(whole, mode="drop"),
            m.valid.at[jnp.where(into < K, slot, K)].set(False, mode="drop"),
        )

    segments = jax.lax.cond(in_any_run(duplicate.any()), joined, lambda: m.segments_world)
    return eqx.tree_at(lambda m: m.segments_world, m, segments)


def _forget(config: MapConfig, m: SegmentMap) -> SegmentMap:
    """Drop what was seen a few times only, long ago."""
    keep = m.valid & ~((m.updates < config.min_updates) & (m.unseen > config.forget))
    return eqx.tree_at(lambda m: m.segments_world.valid, m, keep)
