"""The soft form and its derivatives in one pass over the pairs.

log L = sum_m log(exp(-e_max / 2) + sum_k u), u = exp(-(e + (gap / tau)²) / 2)

For one particle and one observed segment the sum over k is a function of a handful of numbers: the
particle's x, y and heading, the segment's theta, rho, place and length, and the whitening a, b, c.
Its derivatives by these are sums over k of u times what the pair has at hand anyway, so value and
Jacobian come from one loop, and everything before (poses, mount, pixels, sigmas) and any
direction of differentiation is left to JAX: the rule below is linear in the tangents. Derivatives
by the map take a loop of their own.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from sofjax.likelihood.batch.culling import reach
from sofjax.likelihood.batch.kernels import Row, gaps, over_groups, over_observed, row, whitened
from sofjax.likelihood.batch.prepare import Cloud, Lines, Seen, compare_pairs

Sums = dict[str, Array]
Twins = dict[tuple[str, str], Array]

NEGLIGIBLE = 28.0  # in e: a pair this far beyond e_max adds less than a millionth to the sum


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def soft(
    diagonal: bool,
    prune: bool,
    cloud: Cloud,
    seen: Seen,
    lines: Lines,
    e_max: Float[Array, ""],
    tau: Float[Array, ""],
    counts: Float[Array, "M #N"],
) -> Float[Array, "N"]:
    """log L of N particles; differentiable to any order forwards, once backwards.

    **Arguments:**
    - `diagonal`: whether b = 0, and `prune`: whether to leave out what is out of reach.
    - `tau`: metres; without derivative.
    - `counts`: weight of each observed segment, for each particle or for all.
    """
    return _one_pass((diagonal, prune), (), cloud, seen, lines, e_max, tau, counts)[0]


@functools.partial(soft.defjvp, symbolic_zeros=True)
def _soft_jvp(
    diagonal: bool, prune: bool, primals: tuple[Any, ...], tangents: tuple[Any, ...]
) -> tuple[Array, Array]:
    cloud, seen, lines, e_max, tau, counts = primals
    d_cloud, d_seen, d_lines, d_e_max, _, _ = tangents
    by_noise = _moves([d_seen.a, d_seen.b, d_seen.c])
    by_place = _moves([d_seen.theta, d_seen.rho, d_seen.along, d_seen.half])
    wanted = ("pose",) * _moves(d_cloud) + ("place",) * by_place + ("noise",) * by_noise
    value, by_e_max, by_pose, by_seen = _one_pass((diagonal, prune), wanted, *primals)

    # cos and sin of theta move with theta, and have no share of their own
    tangent = by_e_max * _dense(d_e_max)
    for name, derivative in by_pose.items():
        tangent += derivative * _dense(getattr(d_cloud, name))
    for name, derivative in by_seen.items():
        tangent += _dense(getattr(d_seen, name)) @ derivative
    if _moves(d_lines):
        fixed = (cloud, seen, e_max, tau, counts)
        by_map = lambda theta, rho, normal, first, second: _by_map(
            Lines(theta, rho, normal, first, second, lines.matchable), *fixed
        )
        names = ("theta", "rho", "normal", "first", "second")
        moved = tuple(_dense(getattr(d_lines, name)) for name in names)
        tangent += jax.jvp(by_map, tuple(getattr(lines, name) for name in names), moved)[1]
    return value, tangent


def _moves(tangents: Any) -> bool:
    is_zero = lambda leaf: isinstance(leaf, SymbolicZero)
    return not all(map(is_zero, jax.tree.leaves(tangents, is_leaf=is_zero)))


def _dense(tangent: Any) -> Any:
    if isinstance(tangent, SymbolicZero):
        zero: Any = tangent
        return jnp.zeros(zero.shape, zero.dtype)
    return tangent


def _one_pass(
    form: tuple[bool, bool],
    wanted: tuple[str, ...],
    cloud: Cloud,
    seen: Seen,
    lines: Lines,
    e_max: Array,
    tau: Array,
    counts: Array,
) -> tuple[Array, Array, dict[str, Array], dict[str, Array]]:
    """Value, and its derivatives by e_max and the pose [N], by the fields of `seen` [M, N]."""
    diagonal, prune = form
    e_cut = e_max + NEGLIGIBLE + 2 * math.log(max(len(lines.rho), 1))
    near = reach(cloud, seen, lines, e_cut, tau * jnp.sqrt(e_cut), prune, diagonal)
    trigonometry = jnp.cos(cloud.yaw), jnp.sin(cloud.yaw)
    zero = jnp.zeros_like(cloud.x)
    per_pose = ("x", "y", "yaw") if "pose" in wanted else ()
    per_seen = ("theta", "rho", "along", "half") if "place" in wanted else ()
    per_seen += ("a", "b", "c") if "noise" in wanted else ()
    sums = _sums(wanted)

    def one(carry: tuple[Any, ...], m: Array) -> tuple[Any, ...]:
        value, by_e_max, by_pose, by_seen = carry
        r = row(cloud, trigonometry, seen, near, m, 1 / tau, diagonal)
        start = _pair_up({name: zero for name in sums})
        add = lambda total, group: _pair_up(_add(_apart(total), group, r, e_max))
        s = _apart(over_groups(near, m, start, add))
        u = s.pop("u")
        share = counts[m] / (1 + u)
        s = {name: share * total for name, total in s.items()}

        value += counts[m] * jnp.log1p(u)
        by_e_max -= 0.5 * share  # of the 1, which is e_max itself
        if by_pose:
            x = s["x"] + s["gap"] * r.dx
            y = s["y"] + s["gap"] * r.dy
            by_pose = {
                "x": by_pose["x"] + x, "y": by_pose["y"] + y, "yaw": by_pose["yaw"] + s["theta"]
            }  # fmt: skip
        rows = {}
        if "place" in wanted:
            rows = {
                "theta": s["theta"], "rho": r.a * r.side * s["z"],
                "along": r.side * s["gap"] / tau, "half": s["length"] / tau,
            }  # fmt: skip
        if "noise" in wanted:
            b = 0.0 if r.b is None else r.b
            rows["a"] = -(s["zz"] - b / r.c * s["zt"]) / r.a
            rows["b"] = -r.side * s["zt"] / r.c
            rows["c"] = -s["tt"] / r.c
        by_seen = {name: total.at[m].set(rows[name]) for name, total in by_seen.items()}
        return value, by_e_max, by_pose, by_seen

    nothing = (near.count == 0).astype(zero.dtype) @ counts
    start = (
        zero - 0.5 * e_max * counts.sum(axis=0),
        zero - 0.5 * nothing,
        {name: zero for name in per_pose},
        {name: jnp.zeros((len(seen.rho), len(zero)), zero.dtype) for name in per_seen},
    )
    return over_observed(near, start, one)


def _add(total: Sums, group: Array, r: Row, e_max: Array) -> Sums:
    """The sums over k that are in `total`, with one group of map segments added."""
    right = r.c * (np.pi / 2)
    across = r.dy * r.x - r.dx * r.y
    b = 0.0 if r.b is None else r.b
    a = 1.0 if r.b is None else r.a  # the table has it already

    def terms(line: Array) -> Sums:
        """u, and u times half the derivatives of -(e + (gap / tau)²) and what makes them up."""
        z_rho, z_theta = whitened(r, line)
        past, before = (jnp.where(gap > 0, gap, 0) for gap in gaps(r, line))  # one of them is 0
        gap = past + before
        u = jnp.exp(0.5 * (e_max - z_rho * z_rho - z_theta * z_theta - gap * gap))
        u = jnp.where(jnp.abs(z_theta) < right, u, 0)
        x1, y1, x2, y2 = line[4:]
        swing = past * (r.dy * x1 - r.dx * y1 - across) - before * (r.dy * x2 - r.dx * y2 - across)
        return {
            "u": u,
            "x": u * z_rho * (a * line[2]),
            "y": u * z_rho * (a * line[3]),
            "theta": u * (b * z_rho + r.c * z_theta + swing),
            "gap": u * (past - before),
            "z": u * z_rho,
            "length": u * gap,
            "zz": u * z_rho * z_rho,
            "zt": u * z_rho * z_theta,
            "tt": u * z_theta * z_theta,
        }

    for line in group:
        term = terms(line)
        total = {name: value + term[name] for name, value in total.items()}
    return total


def _sums(wanted: tuple[str, ...]) -> list[str]:
    """Names of the sums over k that the wanted derivatives are made of."""
    sums = ["u"]
    sums += ["x", "y"] if "pose" in wanted else []
    sums += ["gap", "theta"] if "pose" in wanted or "place" in wanted else []
    sums += ["z", "length"] if "place" in wanted else []
    sums += ["zz", "zt", "tt"] if "noise" in wanted else []
    return sums


# On the CPU, XLA writes one loop for every result, and each would work out its pairs anew. Two sums
# that share their terms travel as one complex number, so that one loop makes both.
TWINS = (("x", "y"), ("theta", "gap"), ("z", "length"), ("zz", "tt"))


def _pair_up(sums: Sums) -> tuple[Sums, Twins]:
    twins = {pair: lax.complex(*(sums[name] for name in pair)) for pair in TWINS if pair[0] in sums}
    return {name: sums[name] for name in ("u", "zt") if name in sums}, twins


def _apart(carried: tuple[Sums, Twins]) -> Sums:
    singles, twins = carried
    for (first, second), value in twins.items():
        singles = singles | {first: lax.real(value), second: lax.imag(value)}
    return singles


def _by_map(
    lines: Lines, cloud: Cloud, seen: Seen, e_max: Array, tau: Array, counts: Array
) -> Float[Array, "N"]:
    """The same value by plain JAX, one map segment at a time, for the derivatives by the map.

    Only the [M, N] sum is carried. It is linear in what a step adds, so going back needs no copy of
    it, and the step is recomputed instead of kept.
    """
    across = jax.tree.map(lambda leaf: leaf[:, None], seen)

    @functools.partial(jax.checkpoint, prevent_cse=False)  # True gave wrong gradients under jit
    def u(line: Lines) -> Array:
        return soft_weight(cloud, across, line, e_max, tau)

    total = jnp.zeros((len(seen.rho), len(cloud.x)), cloud.x.dtype)
    total, _ = lax.scan(lambda total, line: (total + u(line), None), total, lines)
    return (counts * (jnp.log1p(total) - 0.5 * e_max)).sum(axis=0)


def soft_weight(cloud: Cloud, seen: Seen, line: Lines, e_max: Array, tau: Array) -> Array:
    """exp((e_max - e - (gap / tau)²) / 2) of pairs that broadcast."""
    z_rho, z_theta, past, before = compare_pairs(cloud, seen, line)
    gap = (jnp.maximum(past, 0) + jnp.maximum(before, 0)) / tau
    u = jnp.exp(0.5 * (e_max - z_rho**2 - z_theta**2 - gap**2))
    return jnp.where(seen.matchable & line.matchable, u, 0)
