"""The loops over pairs that can meet: one observed segment and a group of map segments at a time.

All N particles go through a group in one fused loop, particles minor, and only the running result
is kept. Nothing of the size N·M·K, nor N·K, ever exists.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from sofjax.likelihood.batch.culling import Reach
from sofjax.likelihood.batch.prepare import Cloud, Seen, larger


class Row(eqx.Module):
    """One observed segment as each of N particles has it, named near the centre of its `Reach`."""

    a: Float[Array, ""]  # whitening: e = (a d_rho + b d_theta)² + (c d_theta)²
    c: Float[Array, ""]
    b: Float[Array, "N"] | None  # with the sign of the name; None where the covariance is diagonal
    x: Float[Array, "N"]  # metres, the particle's place
    y: Float[Array, "N"]
    a_rho: Float[Array, "N"]  # a times rho
    theta: Float[Array, "N"]  # in the axes of the map, radians
    c_theta: Float[Array, "N"]
    dx: Float[Array, "N"]  # unit vector along the segment, times `scale`
    dy: Float[Array, "N"]
    end: Float[Array, "N"]  # where the segment ends along itself, from the map's origin, scaled
    begin: Float[Array, "N"]
    side: Float[Array, "N"]  # -1 where it is named from its other side


def row(
    cloud: Cloud,
    trigonometry: tuple[Float[Array, "N"], Float[Array, "N"]],
    seen: Seen,
    near: Reach,
    m: Int[Array, ""],
    scale: Float[Array, ""] | float,
    diagonal: bool,
) -> Row:
    """Observed segment m for all particles; a dozen operations for each of them."""
    pick = jax.tree.map(lambda leaf: leaf[m], seen)
    cos, sin = trigonometry
    theta = cloud.yaw + (pick.theta + near.turn[m])
    half_turns = jnp.round((theta - near.centre[m]) * (1 / np.pi))
    odd = jnp.abs(half_turns - 2 * jnp.round(half_turns / 2))
    side = near.side[m] * (1 - 2 * odd)
    dx = (cos * pick.cos - sin * pick.sin) * (side * scale)
    dy = (sin * pick.cos + cos * pick.sin) * (side * scale)
    middle = dx * cloud.x + dy * cloud.y + pick.along * (side * scale)
    return Row(
        a=pick.a, c=pick.c, b=None if diagonal else side * pick.b,
        x=cloud.x, y=cloud.y,
        a_rho=pick.a * pick.rho * side,
        theta=theta - np.pi * half_turns, c_theta=pick.c * (theta - np.pi * half_turns),
        dx=dx, dy=dy,
        end=middle + pick.half * scale, begin=middle - pick.half * scale,
        side=side,
    )  # fmt: skip


def whitened(row: Row, line: Float[Array, "8"]) -> tuple[Array, Array]:
    """The two residuals of a pair whose squares add up to e."""
    theta, rho, nx, ny = line[:4]
    if row.b is None:
        return rho - nx * row.x - ny * row.y - row.a_rho, theta - row.c_theta
    d_theta = theta - row.theta
    z_rho = row.a * (rho - nx * row.x - ny * row.y) - row.a_rho + row.b * d_theta
    return z_rho, row.c * d_theta


def gaps(row: Row, line: Float[Array, "8"]) -> tuple[Array, Array]:
    """How far the map segment begins past the observed one's end, and ends before its beginning."""
    x1, y1, x2, y2 = line[4:]
    return row.dx * x1 + (row.dy * y1 - row.end), row.begin - row.dy * y2 - row.dx * x2


def over_groups(
    near: Reach, m: Int[Array, ""], start: Any, add: Callable[[Any, Array], Any]
) -> Any:
    """`add(carry, lines [size, 8])` for every group of map segments within reach of segment m."""
    size = near.index.shape[2]

    def step(carry: tuple[Array, Any]) -> tuple[Array, Any]:
        g, value = carry
        return g + 1, add(value, near.table[near.index[m, g]])

    begin: Any = (0, start)
    return lax.while_loop(lambda carry: carry[0] * size < near.count[m], step, begin)[1]


def over_observed(near: Reach, start: Any, add: Callable[[Any, Array], Any]) -> Any:
    """`add(carry, m)` for every observed segment that anything is within reach of."""
    some = near.count > 0
    chosen = jnp.nonzero(some, size=len(some))[0]
    return lax.fori_loop(0, some.sum(), lambda i, carry: add(carry, chosen[i]), start)


# Metres of missing overlap are scaled up to where any error is small beside them. In float32 a
# millionth of a metre, less than rounding, already outweighs every e_max.
WALL = 1e12


def hard(
    cloud: Cloud,
    seen: Seen,
    near: Reach,
    e_max: Float[Array, ""],
    counts: Float[Array, "M #N"],
    diagonal: bool,
) -> Float[Array, "N"]:
    """-1/2 sum_m min(min_k e, e_max) over the observed segments that count."""
    trigonometry = jnp.cos(cloud.yaw), jnp.sin(cloud.yaw)
    zero = jnp.zeros_like(cloud.x)

    def one(total: Array, m: Array) -> Array:
        r = row(cloud, trigonometry, seen, near, m, WALL, diagonal)

        def add(best: Array, lines: Array) -> Array:
            for line in lines:
                z_rho, z_theta = whitened(r, line)
                past, before = gaps(r, line)
                e = larger(larger(past, before), z_rho * z_rho + z_theta * z_theta)
                best = jnp.where(e < best, e, best)
            return best

        return total + counts[m] * over_groups(near, m, zero + e_max, add)

    unmatched = e_max * ((near.count == 0).astype(zero.dtype) @ counts)
    return -0.5 * over_observed(near, zero + unmatched, one)
