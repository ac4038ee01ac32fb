"""Which map lines each observed segment may be; step 5 of Fig. 6, before the particles are."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sofjax._pytree import half_if_enough
from sofjax.geometry.angles import wrap
from sofjax.geometry.lines import PolarLine, alignment, polar_differences, rename_covariance
from sofjax.geometry.matrices import inverse_2x2
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import overlap
from sofjax.likelihood.measurements import Measurements
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.likelihood.tracking import Candidates, sortable
from sofjax.segment_map.classify import posterior_given_class
from sofjax.segment_map.local_map import predict_measurement
from sofjax.segment_map.types import MapConfig, SegmentMap

NOTHING = np.iinfo(np.int32).max


def candidate_associations(
    config: MapConfig,
    sensor: SensorModel,
    segment_map: SegmentMap,
    measurements: Measurements,
    T_world_nadir: SE2,
    most: int | None = None,
) -> tuple[Candidates, Int[Array, "M C"], Float[Array, "M"]]:
    """The C map lines most like each measurement, as they should appear from the predicted nadir.

    **Arguments:**
    - `most`: C, if not that of the settings.

    **Returns:** the candidates; their slots in the map; and for each measurement the smallest error
    of all map lines, overlapping or not by up to `join_gap`.
    """
    among = lambda lines: _among(config, sensor, lines, measurements, T_world_nadir, most)
    return half_if_enough(among, segment_map, segment_map.valid)


def _among(
    config: MapConfig,
    sensor: SensorModel,
    segment_map: SegmentMap,
    measurements: Measurements,
    T_world_nadir: SE2,
    most: int | None,
) -> tuple[Candidates, Int[Array, "M C"], Float[Array, "M"]]:
    line, covariance = jax.vmap(posterior_given_class, in_axes=(None, 0, 0))(
        config, segment_map.line, segment_map.covariance
    )
    seen, H = jax.vmap(predict_measurement, in_axes=(0, 0, None))(
        line, segment_map.anchor, T_world_nadir
    )
    lines = PolarLine(seen[:, 0], seen[:, 1])
    spread = H @ covariance @ jnp.swapaxes(H, 1, 2)
    if not sensor.propagate:
        spread = jnp.zeros_like(spread)
    drift = jnp.diag(jnp.array([config.rho_drift, config.theta_drift]) ** 2)
    jitter = (
        sensor.tilt_sigma**2 * measurements.by_jitter @ jnp.swapaxes(measurements.by_jitter, 1, 2)
    )

    # all M × K pairs, in numbers and not in 2×2 matrices: so they compile to one loop
    near, far = measurements.covariance + jitter, spread + drift
    observed = PolarLine(measurements.line.rho[:, None], measurements.line.theta[:, None])
    side = alignment(observed, lines)  # a measurement may be named from the other side
    s = lambda i, j: near[:, None, i, j] + (1 if i == j else side) * far[:, i, j]
    d_rho, d_theta = polar_differences(observed, lines)
    error = s(1, 1) * d_rho**2 - 2 * s(0, 1) * d_rho * d_theta + s(0, 0) * d_theta**2
    error = error / (s(0, 0) * s(1, 1) - s(0, 1) ** 2)

    # apparent extents: an off-floor line is seen magnified about the nadir
    extent = (
        T_world_nadir.inverse().apply(segment_map.segments_world.endpoints) * seen[:, 2, None, None]
    )
    share = overlap(extent, measurements.endpoints_nadir[:, None])
    possible = segment_map.valid & (share > -config.join_gap)
    if config.directed:
        possible = possible & (jnp.abs(wrap(observed.theta - lines.theta)) < jnp.pi / 2)
    error = jnp.where(possible, error, jnp.inf)
    best, slot = _smallest(error, most or config.candidates)
    far = rename_covariance(far[slot], jnp.take_along_axis(side, slot, axis=1))
    S = measurements.covariance[:, None] + far
    candidates = Candidates(
        line=PolarLine(lines.rho[slot], lines.theta[slot]),
        apparent_scale=seen[slot, 2],
        precision=inverse_2x2(S),
        precision_with_jitter=inverse_2x2(S + jitter[:, None]),
        valid=jnp.isfinite(best),
    )
    return candidates, slot, best[:, 0]


def _smallest(
    error: Float[Array, "M K"], count: int
) -> tuple[Float[Array, "M C"], Int[Array, "M C"]]:
    """The few smallest of each row in order, and where; errors alike to 1 in 2^15 by their slot.

    The minimum is taken by halves, as XLA reduces rows number by number.
    """
    K = error.shape[1]
    width = 1 << (K - 1).bit_length()
    key = sortable(error, jnp.arange(K), width)
    key = jnp.pad(key, [(0, 0), (0, width - K)], constant_values=NOTHING)

    def next_smallest(last: Array, _: None) -> tuple[Array, Array]:
        rest = jnp.where(key > last, key, NOTHING)
        while rest.shape[1] > 1:
            rest = jnp.minimum(*jnp.split(rest, 2, axis=1))
        return rest, rest[:, 0]

    # a scan: it prevents XLA from recomputing all errors for each minimum
    none = jnp.full((len(key), 1), -1, jnp.int32)
    found = jax.lax.scan(next_smallest, none, None, length=count)[1].T
    slot = jnp.minimum(found & (width - 1), K - 1)
    return jnp.where(found < NOTHING, jnp.take_along_axis(error, slot, axis=1), jnp.inf), slot
