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

GATE = 3.0  # standard deviations between two descriptions of one line
REACH = 0.25  # metres: beyond this what is likest may be a neighbour
MODEL = (0.004, 0.01, 0.02)  # metres, radians, kappa: what no covariance knows of
LEAST = 3  # sightings: of what is hardly seen all is possible
GAP = 0.3  # metres between two pieces of one line


@jax.jit
def doubles(
    lines: Lines, covariance: Float[Array, "K 3 K 3"], sightings: Int[Array, "K"]
) -> tuple[Int[Array, "K"], Bool[Array, "K"]]:
    """For each line the one that was seen more and agrees with it best, within the gates.

    The two are compared where the line itself is, with the covariance of their difference: two
    edges that were seen side by side are known well against each other and stay two; what was
    seen again after a long way is known badly against what was seen first.

    **Returns:** the other's index, and whether there is one.
    """
    K = lines.valid.shape[0]
    ends = lines.endpoints_world
    model = jnp.diag(jnp.array(MODEL, lines.line.dtype) ** 2)
    blocks = jnp.moveaxis(covariance, 2, 1)  # [K, K, 3, 3]
    own = blocks[jnp.arange(K), jnp.arange(K)]

    def of_line(j):
        here = SE2(ends[j].mean(axis=0), jnp.zeros((), lines.line.dtype))

        def against(i):
            (a, A), (b, B) = (appear(lines.line[k], _anchor(lines, k), here) for k in (i, j))
            A, B = (jnp.concatenate([H, jnp.array([[0.0, 0.0, 1.0]], H.dtype)]) for H in (A, B))
            first, second = PolarLine(a[0], a[1]), PolarLine(b[0], b[1])
            side = jnp.stack([alignment(first, second), jnp.ones_like(a[0]), jnp.ones_like(a[0])])
            d = jnp.append(polar_difference(first, second), a[2] - b[2])
            B = side[:, None] * B
            cross = A @ blocks[i, j] @ B.T
            S = A @ own[i] @ A.T + B @ own[j] @ B.T - cross - cross.T + model
            return d, d @ jnp.linalg.solve(S, d)

        d, error = jax.vmap(against)(jnp.arange(K))
        gap = -jax.vmap(overlap, in_axes=(None, 0))(ends[j], ends)
        more = (sightings > sightings[j]) | ((sightings == sightings[j]) & (jnp.arange(K) < j))
        same = (
            (error < GATE**2)
            & (jnp.abs(d[:, 0]) < REACH)
            & (gap < GAP)
            & (lines.raised == lines.raised[j])
            & lines.valid
            & lines.valid[j]
            & (sightings[j] >= LEAST)
            & more
        )
        return jnp.where(same, error, jnp.inf).argmin(), same.any()

    return jax.lax.map(of_line, jnp.arange(K), batch_size=8)


def _anchor(lines, k):
    return jax.tree.map(lambda a: a[k], lines.anchor)


def representatives(into: np.ndarray, joins: np.ndarray) -> np.ndarray:
    """[K] the line in whose name each goes on; partners were seen more, so no ring is formed."""
    into = np.where(joins, into, np.arange(len(into)))
    while (into[into] != into).any():
        into = into[into]
    return into
