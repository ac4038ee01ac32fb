"""How the map grows: eq. (14), extend-only, R, L and rest, merging doubled lines; III.B."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax.geometry.angles import safe_norm, safe_sqrt, wrap, wrap_axial
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
from sofjax.geometry.segments import Segments, overlap
from sofjax.segment_map.lines import MapRules, SegmentMap, appear, believed, is_raised
from sofjax.sightings import SensorModel, Sightings

TILT_LEFT = 0.1  # share of the wobble's variance that remains when it has been solved for


def integrate(
    rules: MapRules,
    sensor: SensorModel,
    segment_map: SegmentMap,
    near: Int[Array, "L"],
    sightings: Sightings,
    at: Int[Array, "M"],
    like: Int[Array, "M C"],
    known: Bool[Array, "M"],
    new: Bool[Array, "M"],
    tilt: Float[Array, "2"],
    in_view: Bool[Array, "L"],
    T_world_foot: SE2,
) -> tuple[SegmentMap, Int[Array, ""], Int[Array, "M"]]:
    """Step 6 of Fig. 6: an observed segment updates the known line `near[at]` or begins a new one.

    **Arguments:**
    - `near`: slots of the lines that this image may show, of `nearby`; the others only age.
    - `at`, `known`: which of them each sighting is, if any.
    - `like`: those most like each sighting, of `propose`: one may be the same line once more.
    - `new`: sightings that begin a line.
    - `tilt`: wobble (pitch, roll) to correct the sightings for.
    - `in_view`: which of them this image should show, of `in_view`.
    - `T_world_foot`: the chosen pose.

    **Returns:** the map; how many new lines found no free slot; and the slot of each, K for none.
    """
    some = segment_map.take(near)
    some = _update(rules, sensor, some, sightings, at, known, tilt, in_view, T_world_foot)
    some = _merge(rules, some, at, like, known)
    segment_map = _age(segment_map, sightings).put(near, some)
    segment_map, overflow, slot = _insert(rules, segment_map, sightings, new, tilt, T_world_foot)
    return _forget(rules, segment_map), overflow, slot


class _Measurement(eqx.Module):
    """What one image says of each map line: pieces of one line are one measurement of it."""

    touched: Bool[Array, "L"]
    innovation: Float[Array, "L 2"]  # (rho, theta) observed less expected, in the present foot
    precision: Float[Array, "L 2 2"]  # zero where nothing was seen
    covariance: Float[Array, "L 2 2"]  # its inverse; zero where nothing was seen
    expected: Float[Array, "L 3"]  # (rho, theta, kappa) as the line should appear from there
    H: Float[Array, "L 2 3"]  # d(rho, theta) / d(line)


def _measure(rules, sensor, m, sightings, at, tilt, T_world_foot) -> _Measurement:
    L = m.updates.shape[0]
    by_line = lambda a: jax.ops.segment_sum(a, at, L + 1)[:L]
    expected, H = jax.vmap(appear, in_axes=(0, 0, None))(m.line, m.anchor, T_world_foot)
    of = jnp.minimum(at, L - 1)
    # by the map line's name: a sighting may be named from the other side
    line, observed = PolarLine(expected[of, 0], expected[of, 1]), sightings.under_tilt(tilt)
    innovation = -polar_difference(line, observed)
    drift = jnp.diag(jnp.array([rules.rho_drift, rules.theta_drift]) ** 2)
    wobble = sensor.tilt_sigma**2 * sightings.tilt @ jnp.swapaxes(sightings.tilt, 1, 2)
    noise = rename_covariance(sightings.covariance + TILT_LEFT * wobble, alignment(line, observed))
    precision = inverse_2x2(noise + drift)
    touched = by_line(jnp.ones(at.shape)) > 0
    total = by_line(precision)
    seen = touched[:, None, None]
    covariance = jnp.where(seen, inverse_2x2(jnp.where(seen, total, jnp.eye(2))), 0)
    mean = _times(covariance, by_line(_times(precision, innovation)))
    return _Measurement(touched, mean, total, covariance, expected, H)


def _times(matrix, vector):
    return (matrix @ vector[..., None])[..., 0]


def _running_mean(m, seen: _Measurement, T_world_foot):
    """Eq. (14), in the polar form of the moment: rho <- rho gamma + rho' (1 - gamma)."""
    L = seen.touched.shape[0]
    gamma = m.updates / (1 + m.updates)
    polar = seen.expected[:, :2] + (1 - gamma)[:, None] * seen.innovation
    line = jnp.concatenate([polar, jnp.ones((L, 1))], axis=1)
    here = SE2(jnp.broadcast_to(T_world_foot.xy, (L, 2)), jnp.broadcast_to(T_world_foot.yaw, (L,)))
    return line, m.covariance, here


def _kalman(m, seen: _Measurement, T_world_foot):
    """Weighted by covariances, in the anchor, with kappa; Joseph's form stays positive."""
    transpose = lambda a: jnp.swapaxes(a, 1, 2)
    PHt = m.covariance @ transpose(seen.H)
    W = seen.precision
    gain = PHt @ W @ inverse_2x2(jnp.eye(2) + seen.H @ PHt @ W)
    rest = jnp.eye(3) - gain @ seen.H
    covariance = rest @ m.covariance @ transpose(rest) + gain @ seen.covariance @ transpose(gain)
    return m.line + _times(gain, seen.innovation), covariance, m.anchor


def _age(m, sightings):
    """An image has passed; one without segments changes nothing."""
    passed = sightings.valid.any().astype(int)
    resting, unseen = jnp.maximum(m.resting - passed, 0), m.unseen + passed
    return eqx.tree_at(lambda m: (m.resting, m.unseen), m, (resting, unseen))


def _update(rules, sensor, m, sightings, at, known, tilt, in_view, T_world_foot):
    """The known lines move by the rule, and their extents only ever grow."""
    at = jnp.where(known & (m.resting[at] == 0), at, m.updates.shape[0])  # dropped by scatters
    seen = _measure(rules, sensor, m, sightings, at, tilt, T_world_foot)
    rule = _running_mean if rules.rule == "gamma" else _kalman
    touched = seen.touched
    moved = jax.tree.map(
        lambda new, old: jnp.where(touched.reshape(-1, *[1] * (new.ndim - 1)), new, old),
        rule(m, seen, T_world_foot),
        (m.line, m.covariance, m.anchor),
    )
    endpoints = _extend(rules, *moved, m, sightings, at, T_world_foot)
    endpoints = jnp.where(touched[:, None, None], endpoints, m.segments_world.endpoints)
    grown = (safe_norm(endpoints[:, 1] - endpoints[:, 0]) > rules.length) & (
        m.segments_world.length <= rules.length
    )
    passed = sightings.valid.any().astype(int)
    aged = _age(m, sightings)
    line, covariance, anchor = moved
    return SegmentMap(
        segments_world=Segments(endpoints, m.valid),
        anchor=anchor,
        line=line,
        covariance=covariance,
        updates=m.updates + touched.astype(int),
        resting=jnp.where(touched & grown, rules.rest, aged.resting),
        unseen=jnp.where(touched, 0, aged.unseen),
        expected=m.expected + passed * (m.valid & (in_view | touched)).astype(int),
    )


def _within(endpoints_foot, radius):
    """The part of a segment within a disc about the foot, and whether there is any."""
    line = polar_through(endpoints_foot)
    d, n = direction(line), normal(line)
    half = safe_sqrt(radius**2 - line.rho**2)
    along = jnp.clip(endpoints_foot @ d, -half, half)
    return line.rho * n + along[:, None] * d, (half > 0) & (along[0] != along[1])


def _extend(rules, line, covariance, anchor, m, sightings, at, T_world_foot):
    """End points on the updated lines, grown by what was seen within R, never shrunk."""
    L = m.updates.shape[0]
    line, _ = jax.vmap(believed, in_axes=(None, 0, 0))(rules, line, covariance)
    polar = PolarLine(line[:, 0] / line[:, 2], line[:, 1])  # the line itself, not its apparition
    n, d = normal(polar), direction(polar)
    T_anchor_world = anchor.inverse()
    old = jax.vmap(SE2.apply)(T_anchor_world, m.segments_world.endpoints)
    along = jnp.einsum("kij,kj->ki", old, d)

    of = jnp.minimum(at, L - 1)
    near, some = jax.vmap(_within, in_axes=(0, None))(sightings.endpoints_foot, rules.range)
    T_anchor_foot = jax.vmap(lambda T: T @ T_world_foot)(
        jax.tree.map(lambda a: a[of], T_anchor_world)
    )
    points = jax.vmap(SE2.apply)(T_anchor_foot, near / line[of, 2, None, None])
    t = jnp.einsum("mij,mj->mi", points, d[of])
    at = jnp.where(some, at, L)
    low = jnp.minimum(along.min(axis=1), jax.ops.segment_min(t.min(axis=1), at, L + 1)[:L])
    high = jnp.maximum(along.max(axis=1), jax.ops.segment_max(t.max(axis=1), at, L + 1)[:L])
    ends = polar.rho[:, None, None] * n[:, None] + jnp.stack([low, high], 1)[..., None] * d[:, None]
    return jax.vmap(SE2.apply)(anchor, ends)


def _insert(rules, m, sightings, new, tilt, T_world_foot):
    K, M = rules.capacity, new.shape[0]
    near, some = jax.vmap(_within, in_axes=(0, None))(sightings.endpoints_foot, rules.range)
    new = new & some
    free = jnp.nonzero(~m.valid, size=M, fill_value=K)[0]
    slot = jnp.where(new, free[jnp.cumsum(new) - 1], K)
    observed = sightings.under_tilt(tilt)
    line = jnp.stack([observed.rho, observed.theta, jnp.ones(M)], axis=1)
    covariance = jnp.zeros((M, 3, 3)).at[:, :2, :2].set(sightings.covariance)
    covariance = covariance.at[:, 2, 2].set(rules.kappa_sigma**2)
    put = lambda a, b: a.at[slot].set(b, mode="drop")
    overflow = jnp.sum(new & (slot == K))
    grown = SegmentMap(
        segments_world=Segments(
            put(m.segments_world.endpoints, T_world_foot.apply(near)), put(m.valid, True)
        ),
        anchor=SE2(put(m.anchor.xy, T_world_foot.xy), put(m.anchor.yaw, T_world_foot.yaw)),
        line=put(m.line, line),
        covariance=put(m.covariance, covariance),
        updates=put(m.updates, 1),
        resting=put(m.resting, 0),
        unseen=put(m.unseen, 0),
        expected=put(m.expected, 1),
    )
    return grown, overflow, slot


def _merge(rules, m, at, like, known):
    """A line just seen joins an older one that it doubles: the older one's place, both extents."""
    L = m.updates.shape[0]
    ends = m.segments_world.endpoints
    line = jax.vmap(polar_through)(ends)
    n = normal(line)
    raised = jax.vmap(is_raised, in_axes=(None, 0, 0))(rules, m.line, m.covariance)

    mine, me = ends[at][:, None], at[:, None]
    n_like, rho_like = n[like], line.rho[like]
    off = lambda x: jnp.abs(x[..., 0] * n_like[..., 0] + x[..., 1] * n_like[..., 1] - rho_like)
    turn = (wrap if rules.directed else wrap_axial)(line.theta[me] - line.theta[like])
    gap = -overlap(mine, ends[like])
    older = (m.updates[like] > m.updates[me]) | ((m.updates[like] == m.updates[me]) & (like < me))
    double = (
        (jnp.maximum(off(mine[:, :, 0]), off(mine[:, :, 1])) < rules.merge_distance)
        & (jnp.abs(turn) < rules.merge_angle)
        & (gap < rules.join_gap)
        & (raised[like] == raised[me])
        & older
        & m.valid[like]
        & (known & m.valid[at])[:, None]
    )
    into = jnp.where(double, like, L).min(axis=1)  # the first of them
    doubles, first = into < L, jnp.minimum(into, L - 1)
    dying = jnp.zeros(L, bool).at[at].max(doubles)
    joins = doubles & ~dying[first]

    d = direction(line)
    along = jnp.einsum("kij,kj->ki", ends, d)
    t = jnp.einsum("mij,mj->mi", ends[at], d[first])
    into = jnp.where(joins, into, L)
    low = along.min(axis=1).at[into].min(t.min(axis=1), mode="drop")
    high = along.max(axis=1).at[into].max(t.max(axis=1), mode="drop")
    joined = (
        line.rho[:, None, None] * n[:, None] + jnp.stack([low, high], 1)[..., None] * d[:, None]
    )
    grew = jnp.zeros(L, bool).at[into].set(True, mode="drop")
    gone = jnp.zeros(L, bool).at[jnp.where(joins, at, L)].set(True, mode="drop")
    segments = Segments(jnp.where(grew[:, None, None], joined, ends), m.valid & ~gone)
    return eqx.tree_at(lambda m: m.segments_world, m, segments)


def _forget(rules, m):
    """Drop what was seen a few times only, long ago."""
    keep = m.valid & ~((m.updates < rules.min_updates) & (m.unseen > rules.forget))
    return eqx.tree_at(lambda m: m.segments_world.valid, m, keep)
