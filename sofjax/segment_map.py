"""The one map of segments: new or known, eq. (14), extend-only, R, L and rest, merging; III.B.

Each map line is kept as (rho, theta, kappa) in the foot frame from which it was first seen, its
anchor: far from the world's origin the polar form magnifies error (text of II.A), and about the
anchor the first sighting is the estimate itself. kappa = h / (h - z) is its apparent magnification:
1 on the floor, more for the top of a baseboard, less for a reflection below.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.floor import floor_homography, floor_to_image
from sofjax.geometry.angles import safe_norm, safe_sqrt, wrap_axial
from sofjax.geometry.lines import PolarLine, direction, normal, polar_difference, polar_through
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments, overlap
from sofjax.likelihood import Candidates, Comparison, SensorModel, Sightings, mahalanobis


class MapRules(eqx.Module):
    """How the map grows; the paper's R and L, and what goes past it."""

    rule: str = eqx.field(static=True, default="kalman")  # or "gamma", eq. (14)
    classify: bool = eqx.field(static=True, default=True)  # estimate kappa, tell floor from above
    capacity: int = eqx.field(static=True, default=512)  # K
    candidates: int = eqx.field(static=True, default=4)  # C, map lines compared per sighting
    range: float = 5.0  # R, metres: what is farther does not extend a segment
    length: float = 10.0  # L = 2 R, metres: a longer segment rests
    rest: int = 10  # steps
    merge_distance: float = 0.01  # metres between doubled lines
    merge_angle: float = 0.035  # radians
    join_gap: float = 0.3  # metres between two pieces of one line
    kappa_sigma: float = 0.3  # prior of a line that does not lie on the floor
    kappa_above: float = 1.04  # a magnification between these two is taken for floor: nothing ...
    kappa_below: float = 0.7  # ... lies little under a floor, and reflections lie deep
    kappa_gate: float = 3.0  # standard deviations from 1 that tell a line from the floor
    kappa_known: float = 0.07  # standard deviation below which a line may be one of the final map
    correlation: float = 1.0  # sightings in a row that count as one: their errors hang together
    rho_drift: float = 0.002  # metres: no map line is known better than ...
    theta_drift: float = 0.002  # ... this, radians
    forget: int = 50  # steps unseen after which a line of few sightings is dropped
    min_updates: int = 5  # sightings that make a line one of the final map, ...
    min_share: float = 0.25  # ... and their share of the images in which it should have been seen


class SegmentMap(eqx.Module):
    """K slots for map segments."""

    segments_world: Segments  # [K], metres
    anchor: SE2  # [K] T_world_foot of the first sighting
    line: Float[Array, "K 3"]  # (rho, theta, kappa) in the anchor
    covariance: Float[Array, "K 3 3"]
    updates: Int[Array, "K"]  # delta of eq. (14)
    resting: Int[Array, "K"]  # steps left
    unseen: Int[Array, "K"]  # steps since the last sighting
    expected: Int[Array, "K"]  # images in which its middle was in view

    @property
    def valid(self) -> Bool[Array, "K"]:
        return self.segments_world.valid


def empty_map(rules: MapRules) -> SegmentMap:
    K = rules.capacity
    return SegmentMap(
        segments_world=Segments(jnp.zeros((K, 2, 2)), jnp.zeros(K, bool)),
        anchor=SE2(jnp.zeros((K, 2)), jnp.zeros(K)),
        line=jnp.zeros((K, 3)).at[:, 2].set(1),
        covariance=jnp.broadcast_to(jnp.eye(3), (K, 3, 3)),
        updates=jnp.zeros(K, int),
        resting=jnp.zeros(K, int),
        unseen=jnp.zeros(K, int),
        expected=jnp.zeros(K, int),
    )


def is_raised(
    rules: MapRules, line: Float[Array, "3"], covariance: Float[Array, "3 3"]
) -> Bool[Array, ""]:
    """Whether all views of a line together say that it does not lie on the floor."""
    kappa, sigma = line[2], safe_sqrt(covariance[2, 2])
    outside = (kappa > rules.kappa_above) | (kappa < rules.kappa_below)
    return rules.classify & outside & (jnp.abs(kappa - 1) > rules.kappa_gate * sigma)


def believed(
    rules: MapRules, line: Float[Array, "3"], covariance: Float[Array, "3 3"]
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """A line's estimate given its class: of a floor line, conditioned on kappa = 1."""
    gain = covariance[:, 2] / covariance[2, 2]
    on_floor = (line + gain * (1 - line[2])).at[2].set(1)
    certain = covariance - jnp.outer(gain, covariance[2])
    raised = is_raised(rules, line, covariance)
    return jnp.where(raised, line, on_floor), jnp.where(raised, covariance, certain)


def appear(
    line: Float[Array, "3"], anchor: SE2, T_world_foot: SE2
) -> tuple[Float[Array, "3"], Float[Array, "2 3"]]:
    """How a map line should appear from a foot.

    **Returns:** (rho, theta, kappa) about that foot, and d(rho, theta) / d(line).
    """
    T_anchor_foot = anchor.between(T_world_foot)
    polar = PolarLine(line[0], line[1])
    n, d = normal(polar), direction(polar)
    along, across = d @ T_anchor_foot.xy, n @ T_anchor_foot.xy
    rho = line[0] - line[2] * across
    zero, one = jnp.zeros_like(rho), jnp.ones_like(rho)
    H = jnp.stack([jnp.stack([one, line[2] * along, -across]), jnp.stack([zero, one, zero])])
    return jnp.stack([rho, line[1] - T_anchor_foot.yaw, line[2]]), H


def _inverse2(S: Float[Array, "*batch 2 2"]) -> Float[Array, "*batch 2 2"]:
    a, b, c, d = S[..., 0, 0], S[..., 0, 1], S[..., 1, 0], S[..., 1, 1]
    rows = jnp.stack([jnp.stack([d, -b], -1), jnp.stack([-c, a], -1)], -2)
    return rows / (a * d - b * c)[..., None, None]


def propose(
    rules: MapRules,
    sensor: SensorModel,
    segment_map: SegmentMap,
    sightings: Sightings,
    T_world_foot: SE2,
) -> tuple[Candidates, Int[Array, "M C"], Float[Array, "M"]]:
    """The C map lines most like each sighting, as they should appear from the predicted foot.

    **Returns:** the candidates; their slots in the map; and for each sighting the smallest error
    of all map lines, overlapping or not by up to `join_gap`.
    """
    line, covariance = jax.vmap(believed, in_axes=(None, 0, 0))(
        rules, segment_map.line, segment_map.covariance
    )
    seen, H = jax.vmap(appear, in_axes=(0, 0, None))(line, segment_map.anchor, T_world_foot)
    lines = PolarLine(seen[:, 0], seen[:, 1])
    spread = H @ covariance @ jnp.swapaxes(H, 1, 2)
    if not sensor.propagate:
        spread = jnp.zeros_like(spread)
    drift = jnp.diag(jnp.array([rules.rho_drift, rules.theta_drift]) ** 2)
    tilting = sensor.tilt_sigma**2 * sightings.tilt @ jnp.swapaxes(sightings.tilt, 1, 2)

    S = sightings.covariance[:, None] + spread + drift
    S_tilt = S + tilting[:, None]
    W_tilt = _inverse2(S_tilt)
    observed = PolarLine(sightings.line.rho[:, None], sightings.line.theta[:, None])
    difference = polar_difference(observed, lines)
    error = mahalanobis(difference, W_tilt)

    # apparent extents: a raised line is seen magnified about the foot
    extent = T_world_foot.inverse().apply(segment_map.segments_world.endpoints) * seen[:, 2, None, None]
    share = jax.vmap(jax.vmap(overlap, in_axes=(0, None)), in_axes=(None, 0))(
        extent, sightings.endpoints_foot
    )
    error = jnp.where(segment_map.valid & (share > -rules.join_gap), error, jnp.inf)
    best, slot = jax.lax.top_k(-error, rules.candidates)
    rows = jnp.arange(error.shape[0])[:, None]
    candidates = Candidates(
        line=PolarLine(lines.rho[slot], lines.theta[slot]),
        kappa=seen[slot, 2],
        precision=_inverse2(S[rows, slot]),
        precision_tilt=W_tilt[rows, slot],
        valid=jnp.isfinite(best),
    )
    return candidates, slot, -best[:, 0]


def in_view(
    rules: MapRules, camera: Camera, mount: Mount, segment_map: SegmentMap, T_world_robot: SE2
) -> Bool[Array, "K"]:
    """Which map lines have their middle in the image and within R; walls are not known to hide them."""
    H_F = floor_homography(camera, mount, T_world_robot)
    foot = T_world_robot.apply(mount.T_robot_foot.xy)
    middle = segment_map.segments_world.endpoints.mean(axis=1) - foot
    apparent = foot + middle * segment_map.line[:, 2:]
    x, ahead = jax.vmap(floor_to_image, in_axes=(None, 0))(H_F, apparent)
    inside = (x >= 0).all(axis=1) & (x < jnp.array([camera.width, camera.height], float)).all(axis=1)
    return segment_map.valid & ahead & inside & (jnp.sum(middle**2, axis=1) < rules.range**2)


def integrate(
    rules: MapRules,
    sensor: SensorModel,
    segment_map: SegmentMap,
    sightings: Sightings,
    slot: Int[Array, "M"],
    known: Bool[Array, "M"],
    new: Bool[Array, "M"],
    tilt: Float[Array, "2"],
    in_view: Bool[Array, "K"],
    T_world_foot: SE2,
) -> tuple[SegmentMap, Int[Array, ""]]:
    """Step 6 of Fig. 6: every observed segment updates the known line in `slot` or begins a new one.

    **Arguments:**
    - `slot`, `known`: which map line each sighting is, if any.
    - `new`: sightings that begin a line.
    - `tilt`: wobble (pitch, roll) to correct the sightings for.
    - `in_view`: which map lines this image should show, of `in_view`.
    - `T_world_foot`: the chosen pose.

    **Returns:** the map, and how many new lines found no free slot.
    """
    segment_map = _update(
        rules, sensor, segment_map, sightings, slot, known, tilt, in_view, T_world_foot
    )
    segment_map, overflow = _insert(rules, segment_map, sightings, new, tilt, T_world_foot)
    segment_map = _merge(rules, segment_map, slot, known)
    return _forget(rules, segment_map), overflow


def _update(rules, sensor, m, sightings, slot, known, tilt, in_view, T_world_foot):
    K = rules.capacity
    known = known & (m.resting[slot] == 0)
    slot = jnp.where(known, slot, K)  # K: dropped by every scatter
    sum_by_line = lambda a: jax.ops.segment_sum(a, slot, K + 1)[:K]

    # pieces of one line are one measurement (rho, theta) of it, weighted by their precision
    observed = sightings.under_tilt(tilt)
    seen, H = jax.vmap(appear, in_axes=(0, 0, None))(m.line, m.anchor, T_world_foot)
    lines = PolarLine(seen[:, 0], seen[:, 1])
    drift = jnp.diag(jnp.array([rules.rho_drift, rules.theta_drift]) ** 2)
    tilting = sensor.tilt_sigma**2 * sightings.tilt @ jnp.swapaxes(sightings.tilt, 1, 2)
    W = _inverse2(sightings.covariance + drift + 0.1 * tilting) / rules.correlation
    at = jnp.minimum(slot, K - 1)
    innovation = polar_difference(observed, PolarLine(lines.rho[at], lines.theta[at]))
    W_line = sum_by_line(W)
    touched = jax.ops.segment_sum(known.astype(int), slot, K + 1)[:K] > 0
    weighted = sum_by_line((W @ innovation[..., None])[..., 0])
    mean = (_inverse2(jnp.where(touched[:, None, None], W_line, jnp.eye(2))) @ weighted[..., None])[..., 0]

    if rules.rule == "gamma":  # eq. (14), in the polar form of the moment
        gamma = m.updates / (1 + m.updates)
        polar = seen[:, :2] + (1 - gamma)[:, None] * mean
        line = jnp.concatenate([polar, jnp.ones((K, 1))], axis=1)
        covariance = m.covariance
        anchor = SE2(jnp.broadcast_to(T_world_foot.xy, (K, 2)), jnp.broadcast_to(T_world_foot.yaw, (K,)))
    else:
        PHt = m.covariance @ jnp.swapaxes(H, 1, 2)
        gain = PHt @ W_line @ _inverse2(jnp.eye(2) + H @ PHt @ W_line)
        line = m.line + (gain @ mean[..., None])[..., 0]
        rest = jnp.eye(3) - gain @ H  # Joseph's form stays positive in float32
        noise = jnp.where(touched[:, None, None], _inverse2(jnp.where(touched[:, None, None], W_line, jnp.eye(2))), 0)
        covariance = rest @ m.covariance @ jnp.swapaxes(rest, 1, 2) + gain @ noise @ jnp.swapaxes(gain, 1, 2)
        anchor = m.anchor

    keep = lambda a, b: jax.tree.map(
        lambda x, y: jnp.where(touched.reshape(-1, *[1] * (x.ndim - 1)), x, y), a, b
    )
    line, covariance, anchor = keep((line, covariance, anchor), (m.line, m.covariance, m.anchor))
    endpoints = _extend(rules, line, covariance, anchor, m, sightings, slot, T_world_foot)
    grown = safe_norm(endpoints[:, 1] - endpoints[:, 0]) > rules.length
    was_grown = m.segments_world.length > rules.length
    passed = sightings.valid.any().astype(int)  # an image without one segment leaves the map as it was
    return SegmentMap(
        segments_world=Segments(jnp.where(touched[:, None, None], endpoints, m.segments_world.endpoints), m.valid),
        anchor=anchor,
        line=line,
        covariance=covariance,
        updates=m.updates + touched.astype(int),
        resting=jnp.where(touched & grown & ~was_grown, rules.rest, jnp.maximum(m.resting - passed, 0)),
        unseen=jnp.where(touched, 0, m.unseen + passed),
        expected=m.expected + passed * (m.valid & (in_view | touched)).astype(int),
    )


def _within(endpoints_foot, radius):
    """The part of a segment within a disc about the foot, and whether there is any."""
    line = polar_through(endpoints_foot)
    d, n = direction(line), normal(line)
    half = safe_sqrt(radius**2 - line.rho**2)
    along = jnp.clip(endpoints_foot @ d, -half, half)
    return line.rho * n + along[:, None] * d, (half > 0) & (along[0] != along[1])


def _extend(rules, line, covariance, anchor, m, sightings, slot, T_world_foot):
    """End points on the updated lines, grown by what was seen within R, never shrunk."""
    K = rules.capacity
    line, _ = jax.vmap(believed, in_axes=(None, 0, 0))(rules, line, covariance)
    polar = PolarLine(line[:, 0] / line[:, 2], line[:, 1])  # the line itself, not its apparition
    n, d = normal(polar), direction(polar)
    T_anchor_world = anchor.inverse()
    old = jax.vmap(SE2.apply)(T_anchor_world, m.segments_world.endpoints)
    along = jnp.einsum("kij,kj->ki", old, d)

    at = jnp.minimum(slot, K - 1)
    near, some = jax.vmap(_within, in_axes=(0, None))(sightings.endpoints_foot, rules.range)
    T_anchor_foot = jax.vmap(lambda T: T @ T_world_foot)(jax.tree.map(lambda a: a[at], T_anchor_world))
    points = jax.vmap(SE2.apply)(T_anchor_foot, near / line[at, 2, None, None])
    t = jnp.einsum("mij,mj->mi", points, d[at])
    slot = jnp.where(some, slot, K)
    low = jnp.minimum(along.min(axis=1), jax.ops.segment_min(t.min(axis=1), slot, K + 1)[:K])
    high = jnp.maximum(along.max(axis=1), jax.ops.segment_max(t.max(axis=1), slot, K + 1)[:K])
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
    return SegmentMap(
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
    ), overflow


def _merge(rules, m, slot, known):
    """A line just seen joins an older one that it doubles: the older one's place, both extents."""
    K = rules.capacity
    at = jnp.minimum(slot, K - 1)
    ends = m.segments_world.endpoints
    line = jax.vmap(polar_through)(ends)
    n = normal(line)
    raised = jax.vmap(is_raised, in_axes=(None, 0, 0))(rules, m.line, m.covariance)

    offset = jnp.einsum("mij,kj->mki", ends[at], n) - line.rho[:, None]
    turn = wrap_axial(line.theta[at][:, None] - line.theta)
    gap = -jax.vmap(jax.vmap(overlap, in_axes=(None, 0)), in_axes=(0, None))(ends[at], ends)
    older = (m.updates > m.updates[at][:, None]) | (
        (m.updates == m.updates[at][:, None]) & (jnp.arange(K) < at[:, None])
    )
    double = (
        (jnp.abs(offset).max(axis=-1) < rules.merge_distance)
        & (jnp.abs(turn) < rules.merge_angle)
        & (gap < rules.join_gap)
        & (raised == raised[at][:, None])
        & older
        & m.valid
        & (known & m.valid[at])[:, None]
    )
    into = double.argmax(axis=1)
    dying = jnp.zeros(K, bool).at[at].max(double.any(axis=1))
    joins = double.any(axis=1) & ~dying[into]

    d = direction(line)
    along = jnp.einsum("kij,kj->ki", ends, d)
    t = jnp.einsum("mij,mj->mi", ends[at], d[into])
    into = jnp.where(joins, into, K)
    low = along.min(axis=1).at[into].min(t.min(axis=1), mode="drop")
    high = along.max(axis=1).at[into].max(t.max(axis=1), mode="drop")
    joined = line.rho[:, None, None] * n[:, None] + jnp.stack([low, high], 1)[..., None] * d[:, None]
    grew = jnp.zeros(K, bool).at[into].set(True, mode="drop")
    gone = jnp.zeros(K, bool).at[jnp.where(joins, at, K)].set(True, mode="drop")
    segments = Segments(jnp.where(grew[:, None, None], joined, ends), m.valid & ~gone)
    return eqx.tree_at(lambda m: m.segments_world, m, segments)


def _forget(rules, m):
    """Drop what was seen a few times only, long ago."""
    keep = m.valid & ~((m.updates < rules.min_updates) & (m.unseen > rules.forget))
    return eqx.tree_at(lambda m: m.segments_world.valid, m, keep)
