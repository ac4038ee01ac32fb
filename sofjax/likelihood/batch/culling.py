"""Which map segments each observed segment can meet at all, anywhere in the cloud of particles.

A box about the cloud bounds what rho, theta and the overlap of a pair can be. What is out of reach
costs e_max (or adds nothing, in the soft form) for every particle alike and is never evaluated.
The bounds leave room for rounding: a pair dropped could not have changed the sum.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from sofjax.likelihood.batch.prepare import Cloud, Lines, Seen

SEAMS = 32  # directions among which the seam of the angles is placed


class Reach(eqx.Module):
    """Map segments in groups for each observed segment, and the names under which they are met.

    A line is (rho, theta) and (-rho, theta + pi). Each observed segment has a centre; the particle
    turns it to within pi/2 of it, once, and each map segment is listed under the name that is near
    enough: those near the seam, pi/2 from the centre, under two names. So a pair needs no wrapping.
    """

    table: Float[Array, "R 8"]  # theta, rho, n, two end points of each segment under each name;
    # with a diagonal covariance theta, rho and n are whitened, the same for all
    index: Int[Array, "M groups size"]  # rows of the table, the last one where there is no segment
    count: Int[Array, "M"]  # how many of them are segments
    centre: Float[Array, "M"]  # radians, in [0, pi)
    turn: Float[Array, "M"]  # radians, a multiple of pi to be added to the observed direction
    side: Float[Array, "M"]  # its sign of rho


def reach(
    cloud: Cloud,
    seen: Seen,
    lines: Lines,
    e_cut: Float[Array, ""],
    gap_cut: Float[Array, ""],
    prune: bool,
    diagonal: bool,
) -> Reach:
    """List the pairs with e < e_cut and a gap of less than `gap_cut` metres for some particle.

    Only the table has derivatives: which pairs are listed moves nothing.

    **Arguments:**
    - `prune`: or list all of the map, so that every pair is evaluated.
    - `diagonal`: a and c are the same for all observed segments, and b = 0.
    """
    live = _under_three_names(lines)
    if diagonal:
        a, c = seen.a[0], seen.c[0]
        one = jnp.ones_like(a)
        live = live * jnp.stack([c, a, a, a, one, one, one, one])
    cloud, seen, lines, e_cut, gap_cut = lax.stop_gradient((cloud, seen, lines, e_cut, gap_cut))
    inside = lambda a: jnp.where(cloud.finite, a, 0)
    dx, dy = jnp.abs(inside(cloud.x)).max(), jnp.abs(inside(cloud.y)).max()
    low, high = inside(cloud.yaw).min(), inside(cloud.yaw).max()
    yaw, d_yaw = (low + high) / 2, (high - low) / 2
    reach_xy = jnp.hypot(dx, dy)
    table = _under_three_names(lines)
    theta, rho, nx, ny = table[:, 0], table[:, 1], table[:, 2], table[:, 3]
    matchable = jnp.tile(lines.matchable, 3)

    # the deviation of one quantity, whatever the other: e >= d_theta² / variance of theta
    rounding = 1e-3 + 1e-5 * (reach_xy + jnp.abs(jnp.where(lines.matchable, lines.rho, 0)).max())
    sigma_theta = 1 / seen.c
    sigma_rho = jnp.sqrt(1 + (seen.b / seen.c) ** 2) / seen.a
    cut_theta = smaller_than_right(jnp.sqrt(e_cut) * sigma_theta + 1e-3)
    cut_rho = jnp.sqrt(e_cut) * sigma_rho + rounding

    # theta: about the cloud's own heading if that is known well enough, or about any
    narrow = d_yaw + cut_theta < jnp.pi / 2
    turn = jnp.where(narrow, -jnp.pi * jnp.floor((seen.theta + yaw) / jnp.pi), 0)
    side = 1 - 2 * jnp.abs(jnp.remainder(jnp.round(turn / jnp.pi), 2))
    centre = jnp.where(narrow, seen.theta + yaw + turn, _seam(lines, cut_theta.max()) + jnp.pi / 2)
    spread = jnp.where(narrow & prune, d_yaw, jnp.pi / 2)
    listed = jnp.abs(theta - centre[:, None]) < (spread + cut_theta)[:, None]  # two names at most

    if prune:
        difference = jnp.where(
            narrow[:, None],
            jnp.abs(rho - (side * seen.rho)[:, None]),
            jnp.abs(jnp.abs(rho) - jnp.abs(seen.rho)[:, None]),
        )
        listed &= difference <= jnp.abs(nx) * dx + jnp.abs(ny) * dy + cut_rho[:, None]
        listed &= _within(seen, lines, yaw, d_yaw, reach_xy, gap_cut + rounding)
    listed &= matchable & seen.matchable[:, None]

    index, count = _in_groups(listed, _group_size(len(lines.rho), prune))
    return Reach(_with_none(live), index, count, centre, turn, side)


def _within(
    seen: Seen, lines: Lines, yaw: Array, d_yaw: Array, reach_xy: Array, margin: Array
) -> Bool[Array, "M R"]:
    """Whether a pair's middles may come so near along the observed segment that the two overlap."""
    middle = (lines.first + lines.second) / 2
    half = jnp.hypot(*(lines.second - middle).T)
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    direction = jnp.stack([cos * seen.cos - sin * seen.sin, sin * seen.cos + cos * seen.sin], 1)
    between = jnp.abs(direction @ middle.T - seen.along[:, None])
    swing = d_yaw * (jnp.hypot(*middle.T) + reach_xy)
    far = seen.half[:, None] + half + reach_xy + swing + margin
    return jnp.tile(between <= far, 3)


def _in_groups(
    listed: Bool[Array, "M R"], size: int
) -> tuple[Int[Array, "M groups size"], Int[Array, "M"]]:
    """The listed rows of each observed segment in groups, R where there is none; and how many."""
    M, R = listed.shape
    capacity = -(-2 * (R // 3) // size) * size
    rank = jnp.cumsum(listed, axis=1)
    slot = jnp.where(listed, rank - 1, capacity)
    none = jnp.full((M, capacity), R)
    index = none.at[jnp.arange(M)[:, None], slot].set(jnp.arange(R), mode="drop")
    return index.reshape(M, -1, size), rank[:, -1]


def _group_size(K: int, prune: bool) -> int:
    """Pairs that one step of the loops evaluates: few for short lists, else so that K fits."""
    return 8 if prune else -(-(K + K // 20) // -(-K // 20))


def smaller_than_right(angle: Float[Array, "M"]) -> Float[Array, "M"]:
    """At most a right angle: two undirected lines differ by no more."""
    return jnp.minimum(angle, jnp.pi / 2)


def is_exact(seen: Seen, e_cut: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether e < e_cut only for directions that differ by less than a right angle."""
    return (jnp.sqrt(e_cut) / seen.c + 1e-3 < jnp.pi / 2).all()


def _under_three_names(lines: Lines) -> Float[Array, "R 8"]:
    """Every line with theta in [-pi, 0), [0, pi) and [pi, 2 pi); rows as `Reach.table` has them."""
    back = (lines.theta < 0) | (lines.theta >= np.pi)
    theta = jnp.where(back, lines.theta - jnp.pi * jnp.sign(lines.theta), lines.theta)
    forward = jnp.concatenate([lines.normal, lines.first, lines.second], axis=1)
    reverse = jnp.concatenate([-lines.normal, lines.second, lines.first], axis=1)

    def named(half_turns: int) -> Array:
        other = back if half_turns == 0 else ~back
        rho = jnp.where(other, -lines.rho, lines.rho)
        head = jnp.stack([theta + half_turns * jnp.pi, rho], axis=1)
        return jnp.concatenate([head, jnp.where(other[:, None], reverse, forward)], axis=1)

    return jnp.concatenate([named(-1), named(0), named(1)])


def _with_none(table: Float[Array, "R 8"]) -> Float[Array, "R_plus_1 8"]:
    """One more row, a line so far away that it matches nothing."""
    none = jnp.zeros((1, 8), table.dtype).at[0, 1].set(1e7)
    return jnp.concatenate([table, none])


def _seam(lines: Lines, cut: Float[Array, ""]) -> Float[Array, ""]:
    """The direction in [-pi/2, pi/2) that the fewest map segments are near to."""
    seams = jnp.linspace(-np.pi / 2, np.pi / 2, SEAMS, endpoint=False, dtype=lines.theta.dtype)
    turn = lines.theta - seams[:, None]
    near = (jnp.abs(turn - jnp.pi * jnp.round(turn / jnp.pi)) < cut) & lines.matchable
    return seams[near.sum(axis=1).argmin()]
