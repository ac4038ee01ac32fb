"""Lines of a plane: homogeneous and polar form, transfer by a homography; II.A and eq. (9)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sofjax.geometry.angles import safe_arctan2, safe_divide, safe_norm
from sofjax.geometry.se2 import SE2


class PolarLine(eqx.Module):
    """l = (rho, theta): the line n·x = rho with n = (-sin theta, cos theta).

    rho is signed; (rho, theta) and (-rho, theta + pi) are one line.
    """

    rho: Float[Array, "*batch"]  # distance from the origin, in the unit of the plane
    theta: Float[Array, "*batch"]  # angle of the line to the first axis, radians


def line_through(x1: Float[Array, "2"], x2: Float[Array, "2"]) -> Float[Array, "3"]:
    """l = x1 × x2, the homogeneous line through two points; zero if the points coincide."""
    return jnp.cross(jnp.append(x1, 1.0), jnp.append(x2, 1.0))


def cofactor(H: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """det(H) H^-T, which transfers lines without dividing and exists for a singular H too."""
    h1, h2, h3 = H.T
    return jnp.stack([jnp.cross(h2, h3), jnp.cross(h3, h1), jnp.cross(h1, h2)], axis=1)


def transfer_line(H: Float[Array, "3 3"], line: Float[Array, "3"]) -> Float[Array, "3"]:
    """l' ~ H^-T l for points that go by x' ~ H x; up to scale, as every homogeneous line."""
    return cofactor(H) @ line


def polar(line: Float[Array, "3"]) -> PolarLine:
    """Polar form of a homogeneous line; rho = 0, theta = 0 for the line at infinity."""
    a, b, c = line
    return PolarLine(rho=safe_divide(-c, safe_norm(line[:2])), theta=safe_arctan2(-a, b))


def polar_through(endpoints: Float[Array, "2 2"]) -> PolarLine:
    """Polar form of the line through two points, about the origin of their frame.

    Equal to `polar(line_through(x1, x2))`, without the cancellation of x1 × x2 in float32
    when the points are far from the origin and near to each other.
    """
    x1, x2 = endpoints
    d = x2 - x1
    middle = (x1 + x2) / 2
    area = d[0] * middle[1] - d[1] * middle[0]  # d × middle
    return PolarLine(rho=safe_divide(area, safe_norm(d)), theta=safe_arctan2(d[1], d[0]))


def polar_difference(a: PolarLine, b: PolarLine) -> Float[Array, "*batch 2"]:
    """(rho_a - rho_b, theta_a - theta_b) of two lines, whatever the direction of each.

    Differs from the paper: eq. (9) subtracts the numbers as they stand, which jump by the
    sign of rho where a line is named from its other side. Here the normal of `b` is turned to
    that of `a`, and the angle is axial, in [-pi/2, pi/2].
    """
    return jnp.stack(polar_differences(a, b), axis=-1)


def polar_differences(
    a: PolarLine, b: PolarLine
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """`polar_difference` as two arrays, which XLA computes in one loop over many pairs."""
    turn = a.theta - b.theta
    half_turns = jnp.round(turn / jnp.pi)
    return a.rho - _side(half_turns) * b.rho, turn - jnp.pi * half_turns


def alignment(a: PolarLine, b: PolarLine) -> Float[Array, "*batch"]:
    """1 where two lines are named from the same side, -1 where from opposite ones."""
    return _side(jnp.round((a.theta - b.theta) / jnp.pi))


def _side(half_turns: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """1 for even, -1 for odd; `jnp.remainder` is not vectorised by XLA."""
    return 1 - 2 * (half_turns - 2 * jnp.floor(half_turns / 2))


def rename_covariance(
    covariance: Float[Array, "*#batch 2 2"], side: Float[Array, "*#batch"]
) -> Float[Array, "... 2 2"]:
    """Covariance of (rho, theta) of lines by their other name where `side` is -1."""
    same = jnp.ones_like(side)
    signs = jnp.stack([jnp.stack([same, side], axis=-1), jnp.stack([side, same], axis=-1)], axis=-2)
    return covariance * signs


def polar_in_frame(line_a: PolarLine, T_a_b: SE2) -> PolarLine:
    """A line of frame a in the coordinates of frame b."""
    n = normal(line_a)
    return PolarLine(line_a.rho - n @ T_a_b.xy, line_a.theta - T_a_b.yaw)


def normal(line: PolarLine) -> Float[Array, "*batch 2"]:
    """n = (-sin theta, cos theta)."""
    return jnp.stack([-jnp.sin(line.theta), jnp.cos(line.theta)], axis=-1)


def direction(line: PolarLine) -> Float[Array, "*batch 2"]:
    """(cos theta, sin theta)."""
    return jnp.stack([jnp.cos(line.theta), jnp.sin(line.theta)], axis=-1)


def line_point_distance(line: Float[Array, "3"], point: Float[Array, "2"]) -> Float[Array, ""]:
    """Signed distance of a point from a homogeneous line, in the unit of the plane."""
    return safe_divide(line[:2] @ point + line[2], safe_norm(line[:2]))
