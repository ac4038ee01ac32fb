"""Which lines describe one and the same: decided by how well both are known together."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sofjax.geometry.lines import PolarLine, alignment, polar_difference
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import overlap
from sofjax.segment_map import appear
from sofjax.smoothing.lines import Lines
from sofjax.smoothing.marginals import Marginals

GATE = 3.0  # standard deviations between two descriptions of one line
REACH, TURN = 0.25, 0.25  # metres, radians: beyond this what is likest may be a neighbour
MODEL = (0.004, 0.01, 0.02)  # metres, radians, kappa: what no covariance knows of
LEAST = 3  # sightings: of what is hardly seen all is possible
GAP = 0.3  # metres between two pieces of one line
PAIRS = 256  # compared in one call, however many there are


def doubles(
    lines: Lines, marginals: Marginals, sightings: Int[Array, "K"]
) -> tuple[np.ndarray, np.ndarray]:
    """For each line the one that was seen more and agrees with it best, within the gates.

    The two are compared where the line itself is, with the covariance of their difference: two
    edges that were seen side by side are known well against each other and stay two; what was
    seen again after a long way is known badly against what was seen first. What may as well be
    one line as another that is not the same is left for later, when more is known.

    **Returns:** [K] the other's index, and whether there is one.
    """
    K = lines.valid.shape[0]
    i, j = np.nonzero(np.asarray(_near(lines, sightings)))
    into, least, doubtful = np.zeros(K, int), np.full(K, np.inf), np.zeros(K, bool)
    if len(i):
        room = np.zeros(-len(i) % PAIRS, int)
        pairs = np.stack([np.append(i, room), np.append(j, room)], axis=1).reshape(-1, PAIRS, 2)
        error = np.concatenate([_errors(lines, marginals, *some.T) for some in pairs])
        error = dict(zip(zip(i.tolist(), j.tolist(), strict=True), error.tolist(), strict=False))
        for (a, b), e in error.items():
            if e < min(GATE**2, least[b]):
                into[b], least[b] = a, e
        same = lambda a, b: min(error.get((a, b), np.inf), error.get((b, a), np.inf)) < GATE**2
        for (a, b), e in error.items():
            if e < least[b] + GATE**2 and a != into[b] and not same(a, into[b]):
                doubtful[b] = True
    return into, np.isfinite(least) & ~doubtful


def _at(line, anchor, here):
    """A line, and how it depends on (rho, theta, kappa), about a foot."""
    line, H = appear(line, anchor, here)
    return line, jnp.concatenate([H, jnp.array([[0.0, 0.0, 1.0]], H.dtype)])


def _difference(first, second):
    """Of two lines (rho, theta, kappa), and the sides by which the second counts in it."""
    a, b = PolarLine(first[0], first[1]), PolarLine(second[0], second[1])
    side = jnp.stack([alignment(a, b), jnp.ones_like(first[0]), jnp.ones_like(first[0])])
    return jnp.append(polar_difference(a, b), first[2] - second[2]), side


def _middle(ends):
    return SE2(ends.mean(axis=0), jnp.zeros((), ends.dtype))


@jax.jit
def _near(lines: Lines, sightings: Int[Array, "K"]) -> Bool[Array, "K K"]:
    """Pairs (i, j) of which j may be another description of i."""
    K, ends = lines.valid.shape[0], lines.endpoints_world

    def of_line(j):
        here = _middle(ends[j])
        line, _ = jax.vmap(appear, in_axes=(0, 0, None))(lines.line, lines.anchor, here)
        d, _ = jax.vmap(_difference, in_axes=(0, None))(line, line[j])
        gap = -jax.vmap(overlap, in_axes=(None, 0))(ends[j], ends)
        more = (sightings > sightings[j]) | ((sightings == sightings[j]) & (jnp.arange(K) < j))
        return (
            (jnp.abs(d[:, 0]) < REACH)
            & (jnp.abs(d[:, 1]) < TURN)
            & (gap < GAP)
            & ((lines.raised == lines.raised[j]) | lines.vague | lines.vague[j])
            & lines.valid
            & lines.valid[j]
            & (sightings[j] >= LEAST)
            & more
        )

    return jax.lax.map(of_line, jnp.arange(K), batch_size=8).T


@jax.jit
def _errors(
    lines: Lines, marginals: Marginals, i: Int[Array, "pairs"], j: Int[Array, "pairs"]
) -> Float[Array, "pairs"]:
    """Squared difference of the two, in units of its covariance.

    Where neither is known to stand above the floor, the larger of that and the one if both lay on
    it: a height that is free explains too well why two edges of the floor should be one.
    """
    ends = lines.endpoints_world
    model = jnp.diag(jnp.array(MODEL, lines.line.dtype) ** 2)
    above = lines.raised & ~lines.vague

    def difference(i, j, pair, covariance):
        here = _middle(ends[j])
        anchor = lambda k: jax.tree.map(lambda a: a[k], lines.anchor)
        (a, A), (b, B) = _at(pair[:3], anchor(i), here), _at(pair[3:], anchor(j), here)
        d, side = _difference(a, b)
        D = jnp.concatenate([A, -side[:, None] * B], axis=1)
        return d @ jnp.linalg.solve(D @ covariance @ D.T + model, d)

    def of_pair(i, j, own_i, own_j, both):
        pair = jnp.concatenate([lines.line[i], lines.line[j]])
        covariance = jnp.block([[own_i, both], [both.T, own_j]])
        kappa = covariance[:, 2::3]
        gain = kappa @ jnp.linalg.inv(kappa[2::3] + MODEL[2] ** 2 * jnp.eye(2))
        on_floor = pair + gain @ (1 - pair[2::3])
        error = difference(i, j, pair, covariance)
        error_on_floor = difference(i, j, on_floor, covariance - gain @ kappa.T)
        return jnp.maximum(error, jnp.where(above[i] | above[j], 0, error_on_floor))

    of = marginals.of_lines
    return jax.vmap(of_pair)(i, j, of(i, i), of(j, j), of(i, j))


def representatives(into: np.ndarray, joins: np.ndarray) -> np.ndarray:
    """[K] the line in whose name each goes on; partners were seen more, so no ring is formed."""
    into = np.where(joins, into, np.arange(len(into)))
    while (into[into] != into).any():
        into = into[into]
    return into
