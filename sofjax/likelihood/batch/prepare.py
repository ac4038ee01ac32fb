"""What is computed once per particle, observed segment and map segment, before the pairs.

A pair then costs a dozen additions and products. All of it is near the origin: positions count
from the middle of the cloud of particles, headings from that of the first particle, so that
float32 serves a kilometre away from the world's origin as well as at it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sofjax.geometry.angles import safe_arctan2, safe_divide, safe_norm, safe_sqrt, wrap
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments


class Cloud(eqx.Module):
    """N poses of the robot about the middle of their cloud."""

    x: Float[Array, "N"]  # metres
    y: Float[Array, "N"]
    yaw: Float[Array, "N"]  # radians
    finite: Bool[Array, "N"]


class Seen(eqx.Module):
    """M observed segments in the robot frame, turned by the heading that the cloud counts from."""

    theta: Float[Array, "M"]  # radians
    rho: Float[Array, "M"]  # metres
    cos: Float[Array, "M"]  # of theta
    sin: Float[Array, "M"]
    along: Float[Array, "M"]  # of the middle, metres from the foot of the origin on the line
    half: Float[Array, "M"]  # half of the length, metres
    # e = (a d_rho + b d_theta)² + (c d_theta)², from the covariance of (rho, theta)
    a: Float[Array, "M"]
    b: Float[Array, "M"]
    c: Float[Array, "M"]
    matchable: Bool[Array, "M"]


class Lines(eqx.Module):
    """K map segments about the middle of the cloud; n·x = rho, `first` to `second` along theta."""

    theta: Float[Array, "K"]  # radians
    rho: Float[Array, "K"]  # metres
    normal: Float[Array, "K 2"]
    first: Float[Array, "K 2"]  # end points, metres
    second: Float[Array, "K 2"]
    matchable: Bool[Array, "K"]  # valid, and of some length


def smaller(a: Float[Array, "*#shape"], b: Float[Array, "*#shape"]) -> Float[Array, "*#shape"]:
    """`minimum` in one instruction: it does not have to keep NaN."""
    return jnp.where(a < b, a, b)


def larger(a: Float[Array, "*#shape"], b: Float[Array, "*#shape"]) -> Float[Array, "*#shape"]:
    """`maximum` in one instruction: it does not have to keep NaN."""
    return jnp.where(a > b, a, b)


def prepare(
    particles: SE2,
    observed: Segments,
    segment_map: Segments,
    covariance: Float[Array, "M 2 2"],
) -> tuple[Cloud, Seen, Lines]:
    """Everything about the middle of the cloud.

    The choice of the middle moves no pair, so it has no derivative.

    **Arguments:**
    - `particles`: N poses T_world_robot.
    - `observed`, `segment_map`: M segments in the robot frame, K in the world.
    - `covariance`: of (rho, theta) of each pair's difference, positive definite.
    """
    fixed = jax.lax.stop_gradient(particles)
    finite = jnp.isfinite(fixed.xy).all(axis=-1) & jnp.isfinite(fixed.yaw)
    low = jnp.where(finite[:, None], fixed.xy, jnp.inf).min(axis=0)
    high = jnp.where(finite[:, None], fixed.xy, -jnp.inf).max(axis=0)
    middle = jnp.nan_to_num((low + high) / 2)
    heading = jnp.nan_to_num(fixed.yaw[finite.argmax()])

    xy = particles.xy - middle
    cloud = Cloud(xy[:, 0], xy[:, 1], wrap(particles.yaw - heading), finite)

    theta, along, across, length, unit = _line(_without_padding(observed))
    turned = SE2(jnp.zeros_like(middle), heading).rotate(unit)
    mixed, theta_variance = covariance[:, 0, 1], covariance[:, 1, 1]
    a = 1 / safe_sqrt(covariance[:, 0, 0] - mixed**2 / theta_variance)  # of rho, theta given
    seen = Seen(
        wrap(theta + heading), across, turned[:, 0], turned[:, 1], along, length / 2,
        a, -a * mixed / theta_variance, 1 / safe_sqrt(theta_variance), length > 0,
    )  # fmt: skip

    local = _without_padding(Segments(segment_map.endpoints - middle, segment_map.valid))
    theta, _, rho, length, unit = _line(local)
    normal = jnp.stack([-unit[:, 1], unit[:, 0]], axis=-1)
    return cloud, seen, Lines(theta, rho, normal, local[:, 0], local[:, 1], length > 0)


def _without_padding(segments: Segments) -> Float[Array, "n 2 2"]:
    return jnp.where(segments.valid[:, None, None], segments.endpoints, 0)


def _line(endpoints: Float[Array, "n 2 2"]) -> tuple[Array, Array, Array, Array, Array]:
    """Angle, the middle's coordinates along and across the line, length and unit vector."""
    d = endpoints[:, 1] - endpoints[:, 0]
    middle = (endpoints[:, 0] + endpoints[:, 1]) / 2
    length = safe_norm(d)
    unit = safe_divide(d, length[:, None])
    along = unit[:, 0] * middle[:, 0] + unit[:, 1] * middle[:, 1]
    across = unit[:, 0] * middle[:, 1] - unit[:, 1] * middle[:, 0]
    return safe_arctan2(d[:, 1], d[:, 0]), along, across, length, unit


def compare_pairs(
    cloud: Cloud, seen: Seen, lines: Lines
) -> tuple[
    Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]
]:
    """One pair, or arrays of pairs that broadcast, each line named from the side of the other.

    **Returns:** the two whitened residuals of (rho, theta), whose squares add up to e, and how far
    the map segment begins past the end of the observed one, or ends before its beginning, metres:
    where both are negative, the two overlap.
    """
    turn = lines.theta - (cloud.yaw + seen.theta)
    half_turns = jnp.round(turn / jnp.pi)
    side = 1 - 2 * jnp.abs(jnp.remainder(half_turns, 2))
    nx, ny = lines.normal[..., 0], lines.normal[..., 1]
    d_rho = lines.rho - nx * cloud.x - ny * cloud.y - side * seen.rho
    d_theta = turn - jnp.pi * half_turns
    cos, sin = side * jnp.cos(cloud.yaw), side * jnp.sin(cloud.yaw)
    dx, dy = cos * seen.cos - sin * seen.sin, sin * seen.cos + cos * seen.sin
    along = lambda p: dx * (p[..., 0] - cloud.x) + dy * (p[..., 1] - cloud.y) - side * seen.along
    past = along(lines.first) - seen.half
    before = -seen.half - along(lines.second)
    return seen.a * d_rho + side * seen.b * d_theta, seen.c * d_theta, past, before
