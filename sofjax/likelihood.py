"""Sensor model: how well a hypothetical pose explains the observed segments; III.A.

Everything here happens in the frame of the camera's foot, the floor point under the optical
centre with the axes of the robot: there the apparent line of anything parallel to the floor keeps
its direction, and its distance rho is the true one times the magnification kappa = h / (h - z).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.floor import floor_homography, segment_to_floor
from sofjax.geometry.lines import PolarLine, polar_difference, polar_through
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments


class SensorModel(eqx.Module):
    """Gaussian noise of a segment in (rho, theta), and the cost of one that fits nothing."""

    propagate: bool = eqx.field(static=True, default=True)  # or the paper's constant sigmas
    pixel_sigma: float = 0.5  # pixels, of an end point across its segment
    tilt_sigma: float = 0.001  # radians, wobble of pitch and of roll from image to image
    rho_sigma: float = 0.02  # metres; the constant sigmas, and with `propagate` ...
    theta_sigma: float = 0.02  # radians; ... unused
    theta_limit: float = 0.3  # radians; a segment whose direction is known less well is not used
    adaptation: float = 0.3  # share of the surplus misfit by which the noise grows in a step
    noise_max: float = 100.0  # multiple of the variance beyond which it does not grow
    e_max: float = 9.0  # cost of an observed segment that matches nothing


class Sightings(eqx.Module):
    """M observed segments on the floor, with their errors."""

    endpoints_foot: Float[Array, "*batch 2 2"]  # metres
    valid: Bool[Array, "*batch"]
    line: PolarLine  # about the foot
    covariance: Float[Array, "*batch 2 2"]  # of (rho, theta), from noise of the end points alone
    tilt: Float[Array, "*batch 2 2"]  # d(rho, theta) / d(pitch, roll) of the camera's wobble

    def under_tilt(self, tilt: Float[Array, "2"]) -> PolarLine:
        """The lines, corrected for a wobble (pitch, roll) of the mount."""
        shift = self.tilt @ tilt
        return PolarLine(self.line.rho - shift[..., 0], self.line.theta - shift[..., 1])


def sight(
    sensor: SensorModel,
    camera: Camera,
    mount: Mount,
    segments_image: Segments,
    max_depth: Float[Array, ""] | float,
    noise: Float[Array, ""] | float = 1.0,
) -> Sightings:
    """Put an image's segments on the floor together with their own covariances.

    The covariance of (rho, theta) is carried from the pixels by the Jacobian of the inverse
    projection that is used, eq. (13). Differs from the paper: it has one constant sigma, which
    `sensor.propagate = False` brings back.

    **Arguments:**
    - `segments_image`: M segments, pixels of the undistorted image.
    - `max_depth`: metres; what is farther is clipped away.
    - `noise`: multiple of the variance of the pixels.
    """
    foot = mount.T_robot_foot.xy

    def on_floor(endpoints_image, tilt):
        wobbling = eqx.tree_at(
            lambda m: (m.pitch, m.roll), mount, (mount.pitch + tilt[0], mount.roll + tilt[1])
        )
        H_F = floor_homography(camera, wobbling, SE2.identity())
        endpoints, some = segment_to_floor(H_F, endpoints_image, jnp.asarray(max_depth))
        line = polar_through(endpoints - foot)
        return jnp.stack([line.rho, line.theta]), (endpoints - foot, line, some)

    def one(endpoints_image):
        (by_pixel, by_tilt), (endpoints, line, some) = jax.jacfwd(
            on_floor, argnums=(0, 1), has_aux=True
        )(endpoints_image, jnp.zeros(2))
        by_pixel = by_pixel.reshape(2, 4)
        propagated = noise * sensor.pixel_sigma**2 * by_pixel @ by_pixel.T
        return endpoints, line, some, propagated, by_tilt

    endpoints, line, some, covariance, tilt = jax.vmap(one)(segments_image.endpoints)
    if not sensor.propagate:
        constant = jnp.array([sensor.rho_sigma, sensor.theta_sigma]) ** 2
        covariance = jnp.broadcast_to(jnp.diag(constant), covariance.shape)
        tilt = jnp.zeros_like(tilt)
    has_length = (segments_image.endpoints[:, 0] != segments_image.endpoints[:, 1]).any(axis=-1)
    some = some & has_length & (covariance[:, 1, 1] < sensor.theta_limit**2)
    # what is reported at the nominal tilt moves against the correction
    return Sightings(endpoints, some & segments_image.valid, line, covariance, -tilt)


def adapt_noise(
    sensor: SensorModel, noise: Float[Array, ""], misfit: Float[Array, ""]
) -> Float[Array, ""]:
    """Believe the pixels less where matched segments disagree more than their sigmas allow.

    A mount that is only roughly known, a rolling shutter or blur make all of them inconsistent,
    and a filter that is too sure of its sensor then leaves the odometer. Matched errors e have
    the mean 2; the noise never falls below the sensor model's, nor grows so far that nothing
    is ever matched again.
    """
    grown = noise * jnp.exp(sensor.adaptation * (misfit / 2 - 1))
    return jnp.clip(grown, 1, sensor.noise_max)


class Candidates(eqx.Module):
    """C map lines for each of M sightings, as they should appear from the predicted foot."""

    line: PolarLine  # [M, C]
    kappa: Float[Array, "M C"]  # magnification; 1 for what lies on the floor
    precision: Float[Array, "M C 2 2"]  # inverse covariance of the difference, tilt apart
    precision_tilt: Float[Array, "M C 2 2"]  # the same with the wobble of the tilt in it
    valid: Bool[Array, "M C"]


def mahalanobis(
    difference: Float[Array, "*batch 2"], precision: Float[Array, "*#batch 2 2"]
) -> Float[Array, "*batch"]:
    """e = dᵀ W d, written out: for a diagonal W that of the definition, (d_rho/sigma_rho)² + ..."""
    rho, theta = difference[..., 0], difference[..., 1]
    return (
        precision[..., 0, 0] * rho**2
        + 2 * precision[..., 0, 1] * rho * theta
        + precision[..., 1, 1] * theta**2
    )


class Comparison(eqx.Module):
    """One pose against the map."""

    log_likelihood: Float[Array, "*batch"]
    choice: Int[Array, "*batch M"]  # index among the candidates
    error: Float[Array, "*batch M"]  # e of the chosen candidate, its share of the tilt removed
    tilt: Float[Array, "*batch 2"]  # most likely wobble (pitch, roll) of the moment, radians


def compare(
    sensor: SensorModel,
    sightings: Sightings,
    candidates: Candidates,
    T_predicted_foot: SE2,
    used: Bool[Array, "M"],
) -> Comparison:
    """log L = -1/2 sum_m min(min_k e[m,k], e_max) of one pose; vmap over `T_predicted_foot`.

    The wobble of the tilt moves all segments of one image together, which independent errors
    cannot express: the associations are chosen with it as further noise, then its most likely
    value is solved for (two unknowns, prior `tilt_sigma`) and the errors are taken about it.

    **Arguments:**
    - `T_predicted_foot`: the hypothetical foot in the predicted foot's frame, in which the
      candidates are given: near the origin, where the polar form is accurate.
    - `used`: which sightings count, of each particle's own SoF extraction.
    """
    n = jnp.stack([-jnp.sin(candidates.line.theta), jnp.cos(candidates.line.theta)], axis=-1)
    seen = PolarLine(
        candidates.line.rho - candidates.kappa * (n @ T_predicted_foot.xy),
        candidates.line.theta - T_predicted_foot.yaw,
    )
    observed = PolarLine(sightings.line.rho[:, None], sightings.line.theta[:, None])
    difference = polar_difference(observed, seen)
    loose = mahalanobis(difference, candidates.precision_tilt)
    loose = jnp.where(candidates.valid, loose, jnp.inf)
    choice = loose.argmin(axis=1)
    pick = lambda a: jnp.take_along_axis(a, choice.reshape(-1, 1, *[1] * (a.ndim - 2)), 1)[:, 0]
    inlier = used & sightings.valid & (pick(loose) < sensor.e_max)

    d = jnp.where(inlier[:, None], pick(difference), 0)
    W = jnp.where(inlier[:, None, None], pick(candidates.precision), 0)
    JW = jnp.swapaxes(sightings.tilt, -1, -2) @ W
    information = jnp.sum(JW @ sightings.tilt, axis=0)
    gradient = jnp.sum((JW @ d[..., None])[..., 0], axis=0)
    variance = sensor.tilt_sigma**2  # (I + variance A)^-1 variance b: right for variance = 0 too
    a, b, c = (
        1 + variance * information[0, 0],
        variance * information[0, 1],
        1 + variance * information[1, 1],
    )
    g = variance * gradient
    tilt = jnp.stack([c * g[0] - b * g[1], a * g[1] - b * g[0]]) / (a * c - b * b)

    tight = mahalanobis(d - sightings.tilt @ tilt, W)
    error = jnp.where(inlier, jnp.minimum(tight, sensor.e_max), sensor.e_max)
    counted = used & sightings.valid
    prior = jnp.sum(gradient * tilt) - tilt @ information @ tilt  # tiltᵀ tilt / variance
    log_likelihood = -0.5 * (jnp.sum(jnp.where(counted, error, 0)) + prior)
    return Comparison(log_likelihood, choice, error, tilt)
