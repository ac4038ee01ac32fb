"""The soft form of the sensor model near a predicted pose: a density, to differentiate."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sofjax.geometry.matrices import determinant_2x2
from sofjax.geometry.se2 import SE2
from sofjax.likelihood.measurements import Measurements
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.likelihood.tracking import (
    Candidates,
    differences,
    mahalanobis,
    solve_jitter,
    symmetric,
)


def log_density(
    sensor: SensorModel,
    measurements: Measurements,
    candidates: Candidates,
    T_predicted_nadir: SE2,
    known: Float[Array, "M"],
    lines: Float[Array, ""],
    log_elsewhere: Float[Array, ""],
) -> Float[Array, ""]:
    """log p(segments | pose), the soft form of `score`, with its constants; to differentiate.

    Each measurement is one of the map's lines with the probability `known`, any of them alike, and
    anywhere in the image otherwise; the candidates stand for all lines, as the others are too far
    away to matter. The density is that of the end points across the line, per pixel², so that it
    falls when a sigma is too large or too small and compares different mounts. The
    attitude jitter is integrated out about its most likely value, given each candidate's share:
    exactly, if the shares are certain.

    **Arguments:**
    - `known`: probabilities of the measurements, less than 1.
    - `lines`: how many of the map's lines are in view.
    - `log_elsewhere`: log density of a segment that is no line of the map, per pixel².
    """
    paired = measurements.valid[:, None] & candidates.valid
    d_rho, d_theta, by_x, by_y = differences(measurements, candidates)
    x, y = T_predicted_nadir.xy
    moved = jnp.stack([d_rho + (by_x * x + by_y * y), d_theta + T_predicted_nadir.yaw], axis=-1)
    difference = jnp.where(paired[..., None], moved, 0)
    log_area = jnp.where(measurements.valid, measurements.log_area, 0)[:, None]
    known = known[:, None]
    weights = jnp.concatenate([jnp.where(paired, known / lines, 0), 1 - known], axis=1)
    elsewhere = jnp.broadcast_to(log_elsewhere, known.shape)

    def log_mixture(d: Array, W: Array) -> tuple[Array, Array]:
        log_normal = 0.5 * (jnp.log(determinant_2x2(W)) - mahalanobis(d, W)) - jnp.log(2 * jnp.pi)
        each = jnp.concatenate([log_normal + log_area, elsewhere], axis=1)
        return each, jax.nn.logsumexp(each, axis=1, b=weights)

    W, W_tilt = (
        jnp.where(paired[..., None, None], a, jnp.eye(2))
        for a in (candidates.precision, candidates.precision_with_jitter)
    )
    each, total = log_mixture(difference, W_tilt)
    share = weights * jnp.exp(jnp.where(weights > 0, each - total[:, None], -jnp.inf))
    J = jnp.broadcast_to(measurements.by_jitter[:, None], W.shape)
    JW = jnp.swapaxes(J, -1, -2) @ (share[:, :-1, None, None] * W)
    information = jnp.stack(symmetric(jnp.sum(JW @ J, axis=(0, 1))))
    gradient = jnp.sum((JW @ difference[..., None])[..., 0], axis=(0, 1))
    jitter, volume, prior = solve_jitter(sensor, information, gradient)
    _, total = log_mixture(difference - J @ jitter, W)
    return jnp.sum(jnp.where(measurements.valid, total, 0)) - 0.5 * (prior + jnp.log(volume))
