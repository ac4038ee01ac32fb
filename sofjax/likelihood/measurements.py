"""An image's segments as measurements of lines on the floor; II.B, III.A.

Everything here happens in the frame of the camera's nadir, the floor point under the optical
centre with the axes of the robot: there the apparent line of anything parallel to the floor keeps
its direction, and its distance rho is the true one times the apparent scale h / (h - z).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sofjax.geometry.angles import safe_sqrt
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.floor import floor_homography, may_be_upright, segment_to_floor
from sofjax.geometry.lines import PolarLine, polar_through
from sofjax.geometry.matrices import determinant_2x2
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.likelihood.sensor_model import SensorModel


class Measurements(eqx.Module):
    """M observed segments on the floor, with their errors."""

    endpoints_nadir: Float[Array, "*batch 2 2"]  # metres
    valid: Bool[Array, "*batch"]
    line: PolarLine  # about the nadir
    covariance: Float[Array, "*batch 2 2"]  # of (rho, theta), from noise of the end points alone
    by_jitter: Float[Array, "*batch 2 2"]  # d(rho, theta) / d(pitch, roll) of the camera's jitter
    log_area: Float[Array, "*batch"] | float = 0.0  # log of (metres · radians) that a pixel² makes
    upright: Bool[Array, "*batch"] | bool = False  # it may be: no line of the map begins with it

    def without_jitter(self, jitter: Float[Array, "2"]) -> PolarLine:
        """The lines, corrected for the attitude jitter (pitch, roll) of the image."""
        shift = self.by_jitter @ jitter
        return PolarLine(self.line.rho - shift[..., 0], self.line.theta - shift[..., 1])


def measure(
    sensor: SensorModel,
    camera: Camera,
    mount: Mount,
    segments_image: Segments,
    max_depth: Float[Array, ""] | float,
    noise: Float[Array, ""] | float = 1.0,
) -> Measurements:
    """Put an image's segments on the floor together with their own covariances.

    The covariance of (rho, theta) is carried from the pixels by the Jacobian of the inverse
    projection that is used, eq. (13). Differs from the paper: it has one constant sigma, which
    `sensor.propagate = False` brings back.

    **Arguments:**
    - `segments_image`: M segments, pixels of the undistorted image.
    - `max_depth`: metres; what is farther is clipped away.
    - `noise`: multiple of the variance of the pixels.
    """
    nadir = mount.T_robot_nadir.xy

    def on_floor(endpoints_image: Array, jitter: Array) -> tuple[Array, tuple[Any, ...]]:
        jittered = eqx.tree_at(
            lambda m: (m.pitch, m.roll), mount, (mount.pitch + jitter[0], mount.roll + jitter[1])
        )
        H_F = floor_homography(camera, jittered, SE2.identity())
        endpoints, some = segment_to_floor(H_F, endpoints_image, jnp.asarray(max_depth))
        line = polar_through(endpoints - nadir)
        return jnp.stack([line.rho, line.theta]), (endpoints - nadir, line, some)

    def one(endpoints_image: Array) -> tuple[Any, ...]:
        (by_pixel, by_jitter), (endpoints, line, some) = jax.jacfwd(
            on_floor, argnums=(0, 1), has_aux=True
        )(endpoints_image, jnp.zeros(2))
        by_pixel = by_pixel.reshape(2, 4)
        propagated = noise * sensor.pixel_sigma**2 * by_pixel @ by_pixel.T
        area2 = determinant_2x2(by_pixel @ by_pixel.T)
        log_area = 0.5 * jnp.log(jnp.where(area2 > 0, area2, 1))
        return endpoints, line, some, propagated, by_jitter, log_area

    endpoints, line, some, covariance, by_jitter, log_area = jax.vmap(one)(segments_image.endpoints)
    if not sensor.propagate:
        constant = jnp.array([sensor.rho_sigma, sensor.theta_sigma]) ** 2
        covariance = jnp.broadcast_to(jnp.diag(constant), covariance.shape)
        by_jitter = jnp.zeros_like(by_jitter)
    has_length = (segments_image.endpoints[:, 0] != segments_image.endpoints[:, 1]).any(axis=-1)
    some = some & has_length & (covariance[:, 1, 1] < sensor.theta_limit**2)
    nadir_image = floor_homography(camera, mount, SE2.identity()) @ jnp.append(nadir, 1)
    upright = jax.vmap(may_be_upright, in_axes=(None, 0, None))(
        nadir_image, segments_image.endpoints, sensor.upright
    )
    # what is reported at the nominal attitude moves against the correction
    some = some & segments_image.valid
    return Measurements(endpoints, some, line, covariance, -by_jitter, log_area, upright)


PARALLEL = 0.05  # radians up to which directions count as one: the map's lines err so much


def unobservable_direction(
    measurements: Measurements, known: Bool[Array, "M"]
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """The direction along which all known lines run: the pose along it is not observable.

    **Returns:** radians about the nadir, and whether there is such a direction: all known lines
    are parallel within their sigmas.
    """
    theta, variance = (
        jnp.where(known, a, 0) for a in (measurements.line.theta, measurements.covariance[:, 1, 1])
    )
    weight = jnp.where(known, 1 / (variance + PARALLEL**2), 0)
    free = jnp.arctan2(weight @ jnp.sin(2 * theta), weight @ jnp.cos(2 * theta)) / 2
    along = jnp.abs(jnp.sin(theta - free)) < PARALLEL + 3 * safe_sqrt(variance)
    return free, (along | ~known).all() & known.any()
