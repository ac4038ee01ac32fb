"""How the map grows: eq. (14), extend-only, R, L and rest, merging doubled lines; III.B."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax._pytree import in_any_run
from sofjax.geometry.angles import safe_norm, safe_sqrt
from sofjax.geometry.lines import (
    PolarLine,
    alignment,
    direction,
    normal,
    polar_difference,
    polar_through,
    rename_covariance,
)
from sofjax.geometry.matrices import inverse_2x2
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments, overlap, unit
from sofjax.likelihood.measurements import Measurements
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.segment_map.types import (
    MapConfig,
    SegmentMap,
    is_off_floor,
    posterior_given_class,
    predict_measurement,
)

TILT_LEFT = 0.1  # share of the jitter's variance that remains when it has been solved for


def integrate(
    rules: MapConfig,
    sensor: SensorModel,
    segment_map: SegmentMap,
    near: Int[Array, "L"],
    measurements: Measurements,
    at: Int[Array, "M"],
    like: Int[Array, "M C"],
    known: Bool[Array, "M"],
    new: Bool[Array, "M"],
    tilt: Float[Array, "2"],
    in_view: Bool[Array, "L"],
    T_world_nadir: SE2,
) -> tuple[SegmentMap, Int[Array, ""], Int[Array, "M"]]:
    """Step 6 of Fig. 6: an observed segment updates the known line `near[at]` or begins a new one.

    **Arguments:**
    - `near`: slots of the lines that this image may show, of `nearby`; the others only age.
    - `at`, `known`: which of them each measurement is, if any.
    - `like`: the most similar map lines of each measurement, by `candidate_associations`.
    - `new`: measurements that begin a line.
    - `tilt`: jitter (pitch, roll) to correct the measurements for.
    - `in_view`: which of them this image should show, of `in_view`.
    - `T_world_nadir`: the chosen pose.

    **Returns:** the map; how many new lines found no free slot; and the slot of each, K for none.
    """
    K, L = segment_map.updates.shape[0], near.shape[0]
    slot = jnp.where(known, near[at], K)
    resting = segment_map.resting.at[slot].get(mode="clip") > 0
    moving = jnp.where(known & ~resting, slot, K)
    in_view = in_view.at[jnp.where(moving < K, at, L)].set(True, mode="drop")
    segment_map = _age(segment_map, near, in_view, measurements)
    segment_map = _update(rules, sensor, segment_map, measurements, moving, tilt, T_world_nadir)
    segment_map = _merge(rules, segment_map, slot, near[like.T])
    segment_map, overflow, slot = _insert(
        rules, segment_map, measurements, new, tilt, T_world_nadir
    )
    return _forget(rules, segment_map), overflow, slot


def _age(m, near, in_view, measurements):
    """An image has passed, in which some lines should have been; one without segments is none."""
    passed = measurements.valid.any().astype(int)
    return eqx.tree_at(
        lambda m: (m.resting, m.unseen, m.expected), m,
        (jnp.maximum(m.resting - passed, 0), m.unseen + passed,
         m.expected.at[near].add(passed * (in_view & m.valid[near]).astype(int), mode="drop")),
    )  # fmt: skip


def _together(slot, K):
    """[M, M] Which measurements go to the same slot; K for none."""
    return (slot == slot[:, None]) & (slot < K)


class _Measurement(eqx.Module):
    """One image's measurement of each line: pieces of one line count as one."""

    innovation: Float[Array, "M 2"]  # (rho, theta) observed less expected, in the present nadir
    precision: Float[Array, "M 2 2"]
    covariance: Float[Array, "M 2 2"]  # its inverse
    expected: Float[
        Array, "M 3"
    ]  # (rho, theta, apparent scale) as the line should appear from there
    H: Float[Array, "M 2 3"]  # d(rho, theta) / d(line)


def _measure(rules, sensor, m, measurements, together, tilt, T_world_nadir) -> _Measurement:
    M = m.updates.shape[0]
    expected, H = jax.vmap(predict_measurement, in_axes=(0, 0, None))(
        m.line, m.anchor, T_world_nadir
    )
    # by the map line's name: a measurement may be named from the other side
    line, observed = PolarLine(expected[:, 0], expected[:, 1]), measurements.without_jitter(tilt)
    innovation = -polar_difference(line, observed)
    drift = jnp.diag(jnp.array([rules.rho_drift, rules.theta_drift]) ** 2)
    jitter = (
        sensor.tilt_sigma**2 * measurements.by_jitter @ jnp.swapaxes(measurements.by_jitter, 1, 2)
    )
    noise = rename_covariance(
        measurements.covariance + TILT_LEFT * jitter, alignment(line, observed)
    )
    precision = inverse_2x2(noise + drift)
    each = jnp.concatenate([precision.reshape(M, 4), _times(precision, innovation)], axis=1)
    moves = together.any(axis=0)[:, None]  # the others are padding, and not even zero times it
    each = jnp.where(moves, each, 0)
    total = jnp.matmul(together.astype(float), each, precision=jax.lax.Precision.HIGHEST)
    precision = jnp.where(moves[..., None], total[:, :4].reshape(M, 2, 2), jnp.eye(2))
    covariance = inverse_2x2(precision)
    return _Measurement(_times(covariance, total[:, 4:]), precision, covariance, expected, H)


def _times(matrix, vector):
    return (matrix @ vector[..., None])[..., 0]


def _running_mean(m, seen: _Measurement, T_world_nadir):
    """Eq. (14), in the polar form of the moment: rho <- rho gamma + rho' (1 - gamma)."""
    M = m.updates.shape[0]
    gamma = m.updates / (1 + m.updates)
    polar = seen.expected[:, :2] + (1 - gamma)[:, None] * seen.innovation
    line = jnp.concatenate([polar, jnp.ones((M, 1))], axis=1)
    here = SE2(
        jnp.broadcast_to(T_world_nadir.xy, (M, 2)), jnp.broadcast_to(T_world_nadir.yaw, (M,))
    )
    return line, m.covariance, here


def _kalman(m, seen: _Measurement, T_world_nadir):
    """Kalman update in the anchor frame, with the apparent scale; Joseph form."""
    transpose = lambda a: jnp.swapaxes(a, 1, 2)
    PHt = m.covariance @ transpose(seen.H)
    W = seen.precision
    gain = PHt @ W @ inverse_2x2(jnp.eye(2) + seen.H @ PHt @ W)
    rest = jnp.eye(3) - gain @ seen.H
    covariance = rest @ m.covariance @ transpose(rest) + gain @ seen.covariance @ transpose(gain)
    return m.line + _times(gain, seen.innovation), covariance, m.anchor


def _update(rules, sensor, segment_map, measurements, slot, tilt, T_world_nadir):
    """The known lines move by the rule, and their extents only ever grow."""
    K = segment_map.updates.shape[0]
    together = _together(slot, K)
    m = segment_map.take(slot)  # [M]
    seen = _measure(rules, sensor, m, measurements, together, tilt, T_world_nadir)
    rule = _running_mean if rules.rule == "gamma" else _kalman
    line, covariance, anchor = rule(m, seen, T_world_nadir)
    endpoints = _extend(rules, line, covariance, anchor, m, measurements, together, T_world_nadir)
    grown = (safe_norm(endpoints[:, 1] - endpoints[:, 0]) > rules.length) & (
        m.segments_world.length <= rules.length
    )
    moved = SegmentMap(
        segments_world=Segments(endpoints, m.valid),
        anchor=anchor,
        line=line,
        covariance=covariance,
        updates=m.updates + 1,
        resting=jnp.where(grown, rules.rest, m.resting),
        unseen=jnp.zeros_like(m.unseen),
        expected=m.expected,
    )
    order = jnp.arange(slot.shape[0])
    again = (together & (order[:, None] < order)).any(axis=0)  # the first piece stands for all
    return segment_map.put(jnp.where(again, K, slot), moved)


def _within(endpoints_nadir, radius):
    """The part of a segment within a disc about the nadir, and whether there is any."""
    line = polar_through(endpoints_nadir)
    d, n = direction(line), normal(line)
    half = safe_sqrt(radius**2 - line.rho**2)
    along = jnp.clip(endpoints_nadir @ d, -half, half)
    return line.rho * n + along[:, None] * d, (half > 0) & (along[0] != along[1])


def _extend(rules, line, covariance, anchor, m, measurements, together, T_world_nadir):
    """End points on the updated lines, grown by what was seen within R, never shrunk."""
    line, _ = jax.vmap(posterior_given_class, in_axes=(None, 0, 0))(rules, line, covariance)
    polar = PolarLine(line[:, 0] / line[:, 2], line[:, 1])  # the line itself, not its apparition
    T_anchor_world = anchor.inverse()
    old = jax.vmap(SE2.apply)(T_anchor_world, m.segments_world.endpoints)

    near, some = jax.vmap(_within, in_axes=(0, None))(measurements.endpoints_nadir, rules.range)
    T_anchor_nadir = jax.vmap(lambda T: T @ T_world_nadir)(T_anchor_world)
    points = jax.vmap(SE2.apply)(T_anchor_nadir, near / line[:, 2, None, None])
    return jax.vmap(SE2.apply)(anchor, _spanned(polar, old, points, together & some[:, None]))


def _spanned(line, old, new, together):
    """[M, 2, 2] End points on each line that span its old ones and all new ones that go with it."""
    n, d = normal(line), direction(line)
    along, t = (jnp.einsum("mij,mj->mi", ends, d) for ends in (old, new))
    low = jnp.where(together, t.min(axis=1)[:, None], jnp.inf).min(axis=0)
    high = jnp.where(together, t.max(axis=1)[:, None], -jnp.inf).max(axis=0)
    reach = jnp.minimum(along.min(axis=1), low), jnp.maximum(along.max(axis=1), high)
    return line.rho[:, None, None] * n[:, None] + jnp.stack(reach, 1)[..., None] * d[:, None]


def _insert(rules, m, measurements, new, tilt, T_world_nadir):
    K, M = rules.capacity, new.shape[0]
    near, some = jax.vmap(_within, in_axes=(0, None))(measurements.endpoints_nadir, rules.range)
    new = new & some
    free = jnp.nonzero(~m.valid, size=M, fill_value=K)[0]
    slot = jnp.where(new, free[jnp.cumsum(new) - 1], K)
    observed = measurements.without_jitter(tilt)
    line = jnp.stack([observed.rho, observed.theta, jnp.ones(M)], axis=1)
    covariance = jnp.zeros((M, 3, 3)).at[:, :2, :2].set(measurements.covariance)
    covariance = covariance.at[:, 2, 2].set(rules.scale_sigma**2)
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


def _merge(rules, m, slot, like):
    """A line just seen joins an older one that it doubles: the older one's place, both extents.

    **Arguments:**
    - `slot`: [M] the lines just seen, K for none; `like`: [C, M] what each may double.
    """
    K = m.updates.shape[0]
    get = lambda leaf, slot: leaf.at[slot].get(mode="fill", fill_value=0)
    off_floor = lambda slot: is_off_floor(rules, get(m.line, slot), get(m.covariance, slot))
    mine, ends = get(m.segments_world.endpoints, slot), get(m.segments_world.endpoints, like)
    # by unit vectors: angles of all pairs would take most of the time
    d, d_like = unit(mine), unit(ends)
    cos = d[:, 0] * d_like[..., 0] + d[:, 1] * d_like[..., 1]
    off = lambda x: jnp.abs(
        (x[:, 1] - ends[..., 0, 1]) * d_like[..., 0] - (x[:, 0] - ends[..., 0, 0]) * d_like[..., 1]
    )
    updates, updates_like = get(m.updates, slot), get(m.updates, like)
    double = (
        (jnp.maximum(off(mine[:, 0]), off(mine[:, 1])) < rules.merge_distance)
        & ((cos if rules.directed else jnp.abs(cos)) > jnp.cos(rules.merge_angle))
        & (-overlap(mine, ends) < rules.join_gap)
        & (off_floor(like) == off_floor(slot))
        & ((updates_like > updates) | ((updates_like == updates) & (like < slot)))  # older
        & get(m.valid, like)
        & get(m.valid, slot)
    )

    def joined():
        into = jnp.where(double, like, K).min(axis=0)  # the first of them
        dying = jnp.zeros(K, bool).at[slot].max(into < K, mode="drop")
        into = jnp.where(get(dying, into), K, into)
        old = get(m.segments_world.endpoints, into)
        whole = _spanned(jax.vmap(polar_through)(old), old, mine, _together(into, K))
        return Segments(
            m.segments_world.endpoints.at[into].set(whole, mode="drop"),
            m.valid.at[jnp.where(into < K, slot, K)].set(False, mode="drop"),
        )

    segments = jax.lax.cond(in_any_run(double.any()), joined, lambda: m.segments_world)
    return eqx.tree_at(lambda m: m.segments_world, m, segments)


def _forget(rules, m):
    """Drop what was seen a few times only, long ago."""
    keep = m.valid & ~((m.updates < rules.min_updates) & (m.unseen > rules.forget))
    return eqx.tree_at(lambda m: m.segments_world.valid, m, keep)
