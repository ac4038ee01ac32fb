"""Which lines describe one and the same: decided by how well all of them are known together."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sofjax.geometry.lines import PolarLine, alignment, polar_difference
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import overlap
from sofjax.segment_map import predict_measurement
from sofjax.smoothing.association.joint_compatibility import GATE, WIDE, compatible
from sofjax.smoothing.association.lines import Lines
from sofjax.smoothing.sparse.marginals import Marginals

REACH, TURN = 0.4, 0.25  # metres, radians: beyond this what is likest may be a neighbour
MODEL = (0.004, 0.01, 0.02)  # metres, radians, the apparent scale: what no covariance knows of
LEAST = 3  # measurements: of what is hardly seen all is possible
GAP = 0.3  # metres between two pieces of one line
PAIRS = 128  # tested jointly


def duplicates(
    lines: Lines, marginals: Marginals, measurements: Int[Array, "K"]
) -> tuple[np.ndarray, np.ndarray]:
    """For each line another that was seen more and is the same, if there is one.

    Two are compared where the line itself is, with the covariance of their difference. Two edges
    that were seen side by side are well known relative to each other and stay two. A revisited line
    is badly known relative to its first description, so all candidate pairs of a place are tested
    jointly (`compatible`). A line that fits two others equally well is left until more is known.

    **Returns:** [K] the other's index, and whether there is one.
    """
    K = lines.valid.shape[0]
    near, beside = map(np.asarray, _compared(lines, measurements))
    i, j = np.nonzero(near)
    since = np.asarray(lines.span[:, 0])
    order = np.argsort(np.maximum(since[i], since[j]), kind="stable")  # one place after the other
    i, j = i[order], j[order]
    into, joins, error = np.zeros(K, int), np.zeros(K, bool), np.full((K, K), np.inf)
    if not len(i):
        return into, joins
    parts = [_filled(i[some], j[some]) for some in _parts(len(i))]
    own = np.arange(PAIRS)
    of = [_differences(lines, *part, _covariance(marginals, *part)[own, :, own]) for part in parts]
    of = jax.tree.map(lambda *parts: np.concatenate(parts)[: len(i)], *of)
    error[i, j] = of.squared
    two = beside & ~np.eye(K, dtype=bool) & ~(np.minimum(error, error.T) < GATE**2)

    alone = of.squared < WIDE**2
    i, j, of = i[alone], j[alone], jax.tree.map(lambda a: a[alone], of)
    for some in _parts(len(i)):
        a, b, these = i[some], j[some], jax.tree.map(lambda v, s=some: v[s], of)
        C = np.asarray(_covariance(marginals, *_filled(a, b)))[: len(a), :, : len(a)]
        S = np.einsum("pia,paqb,qjb->piqj", these.by_lines, C, these.by_lines, optimize=True)
        n = np.arange(len(a))
        S[n, :, n] += these.own
        sides = (a, b), (b, a)  # of two pairs with a line in common, is the rest two lines?
        rivals = [(x[:, None] == y) & two[u[:, None], v] for x, u in sides for y, v in sides]
        for k in compatible(these.value, S, np.any(rivals, axis=0)):
            if not joins[b[k]] or error[a[k], b[k]] < error[into[b[k]], b[k]]:
                into[b[k]], joins[b[k]] = a[k], True
    return into, joins


def _parts(size: int) -> list[slice]:
    return [slice(k, min(k + PAIRS, size)) for k in range(0, size, PAIRS)]


def _filled(*indices: np.ndarray) -> list[np.ndarray]:
    return [np.append(a, np.zeros(PAIRS - len(a), int)) for a in indices]


def _at(line: Float[Array, "3"], anchor: SE2, here: SE2) -> tuple[Array, Array]:
    """A line, and how it depends on (rho, theta, apparent scale), about a nadir."""
    line, H = predict_measurement(line, anchor, here)
    return line, jnp.concatenate([H, jnp.array([[0.0, 0.0, 1.0]], H.dtype)])


def _difference(first: Float[Array, "3"], second: Float[Array, "3"]) -> tuple[Array, Array]:
    """The difference of two lines (rho, theta, apparent scale), and the second's signs in it."""
    a, b = PolarLine(first[0], first[1]), PolarLine(second[0], second[1])
    side = jnp.stack([alignment(a, b), jnp.ones_like(first[0]), jnp.ones_like(first[0])])
    return jnp.append(polar_difference(a, b), first[2] - second[2]), side


def _middle(ends: Float[Array, "2 2"]) -> SE2:
    return SE2(ends.mean(axis=0), jnp.zeros((), ends.dtype))


@jax.jit
def _compared(
    lines: Lines, measurements: Int[Array, "K"]
) -> tuple[Bool[Array, "K K"], Bool[Array, "K K"]]:
    """Pairs (i, j) of which j may be another description of i; and pairs that lie side by side."""
    K, ends = lines.valid.shape[0], lines.endpoints_world

    def of_line(j: Array) -> tuple[Array, Array]:
        here = _middle(ends[j])
        line, _ = jax.vmap(predict_measurement, in_axes=(0, 0, None))(
            lines.line, lines.anchor, here
        )
        d, _ = jax.vmap(_difference, in_axes=(0, None))(line, line[j])
        shared = jax.vmap(overlap, in_axes=(None, 0))(ends[j], ends)
        more = (measurements > measurements[j]) | (
            (measurements == measurements[j]) & (jnp.arange(K) < j)
        )
        both = lines.valid & lines.valid[j]
        near = (
            (jnp.abs(d[:, 0]) < REACH)
            & (jnp.abs(d[:, 1]) < TURN)
            & (shared > -GAP)
            & ((lines.off_floor == lines.off_floor[j]) | lines.undetermined | lines.undetermined[j])
            & (measurements[j] >= LEAST)
            & more
        )
        return near & both, (shared > 0) & both

    near, beside = jax.lax.map(of_line, jnp.arange(K), batch_size=8)
    return near.T, beside & beside.T


class Difference(eqx.Module):
    """Of the two lines of a pair, (rho, theta, apparent scale)."""

    value: Float[Array, "*pairs 3"]
    by_lines: Float[Array, "*pairs 3 6"]  # how it depends on the two
    own: Float[Array, "*pairs 3 3"]  # covariance of what is no error of the lines
    squared: Float[Array, "*pairs"]  # in units of its covariance


@jax.jit
def _differences(
    lines: Lines,
    i: Int[Array | np.ndarray, "pairs"],
    j: Int[Array | np.ndarray, "pairs"],
    covariance: Float[Array, "pairs 6 6"],
) -> Difference:
    """Where neither line is known to stand above the floor, the larger one of that and of what it
    is if both lay on it: a height that is free explains too well why two edges should be one.
    """
    ends = lines.endpoints_world
    model = jnp.asarray(MODEL, lines.line.dtype) ** 2
    above = lines.off_floor & ~lines.undetermined

    def difference(
        i: Array, j: Array, pair: Array, by_pair: Array, own: Array, covariance: Array
    ) -> Difference:
        here = _middle(ends[j])
        anchor = lambda k: jax.tree.map(lambda a: a[k], lines.anchor)
        (a, A), (b, B) = _at(pair[:3], anchor(i), here), _at(pair[3:], anchor(j), here)
        value, side = _difference(a, b)
        D = jnp.concatenate([A, -side[:, None] * B], axis=1)
        by_lines, own = D @ by_pair, jnp.diag(model) + D @ own @ D.T
        error = by_lines @ covariance @ by_lines.T + own
        return Difference(value, by_lines, own, value @ jnp.linalg.solve(error, value))

    def of_pair(i: Array, j: Array, covariance: Array) -> Difference:
        pair = jnp.concatenate([lines.line[i], lines.line[j]])
        apparent_scale = covariance[:, 2::3]
        gain = apparent_scale @ jnp.linalg.inv(apparent_scale[2::3] + model[2] * jnp.eye(2))
        by_rest = jnp.eye(6).at[:, 2::3].add(-gain)
        free = difference(i, j, pair, jnp.eye(6), jnp.zeros((6, 6)), covariance)
        spread = model[2] * gain @ gain.T
        on_floor = difference(i, j, pair + gain @ (1 - pair[2::3]), by_rest, spread, covariance)
        lie = ~(above[i] | above[j]) & (on_floor.squared > free.squared)
        return jax.tree.map(partial(jnp.where, lie), on_floor, free)

    return jax.vmap(of_pair)(jnp.asarray(i), jnp.asarray(j), covariance)


@jax.jit
def _covariance(
    marginals: Marginals, i: Int[Array | np.ndarray, "pairs"], j: Int[Array | np.ndarray, "pairs"]
) -> Float[Array, "pairs 6 pairs 6"]:
    """Of the two lines of each pair with those of all others."""
    P = len(i)
    return marginals.of_lines(jnp.stack([i, j], axis=1).ravel()).reshape(P, 6, P, 6)


def representatives(into: np.ndarray, joins: np.ndarray) -> np.ndarray:
    """[K] the line in whose name each goes on; partners were seen more, so no ring is formed."""
    into = np.where(joins, into, np.arange(len(into)))
    while (into[into] != into).any():
        into = into[into]
    return into
