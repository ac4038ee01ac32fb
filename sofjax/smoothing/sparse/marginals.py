"""How sure a solution is: covariances of its poses, and of its lines with each other."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Float, Int

from sofjax.smoothing.problem import LINE, POSE, SHARED
from sofjax.smoothing.sparse.dissection import BRANCH
from sofjax.smoothing.sparse.elimination import Factors


class Marginals(eqx.Module):
    """Parts of the inverse of the normal equations."""

    factors: Factors
    within: tuple[Float[Array, "_ _ _"], ...]  # [N, a + q, a + q] of (own, border), by generation
    pose: Float[Array, "n 5 5"]

    @property
    def shared(self) -> Float[Array, "8 8"]:
        d = self.factors.dissection
        at = jnp.searchsorted(d.generations[-1].own[0], d.size - SHARED)  # the root's last
        return jax.lax.dynamic_slice(self.within[-1][0], (at, at), (SHARED, SHARED))

    def of_lines(self, lines: Int[Array | np.ndarray, "L"]) -> Float[Array, "L 3 L 3"]:
        """Of some lines together.

        Each is followed up the tree, as a combination of what ever higher nodes border on; two are
        known together by the lowest node above both.
        """
        d = self.factors.dissection
        leaf, place = d.line
        start = jnp.zeros((LINE, self.within[0].shape[1]))
        itself = lambda k: start.at[:, place[k] + jnp.arange(LINE)].set(jnp.eye(LINE))
        rows, nodes = jax.vmap(itself)(lines), leaf[lines]
        found = jnp.zeros((len(lines), LINE, len(lines), LINE))
        met = jnp.zeros((len(lines), len(lines)), bool)
        for height, within in enumerate(self.within):
            if height:
                rows = jax.lax.map(partial(self._lifted, height - 1), (rows, nodes))
                nodes = nodes // BRANCH
            meet = (nodes[:, None] == nodes) & ~met
            known = jax.lax.map(
                lambda each, within=within: each[0] @ within[each[1]], (rows, nodes)
            )
            between = jnp.einsum("akw,blw->akbl", known, rows)
            found = jnp.where(meet[:, None, :, None], between, found)
            met = met | meet
        return found

    def _lifted(self, height: int, each: tuple[Array, Array]) -> Array:
        """A combination of what a node knows as one of what its parent knows."""
        row, node = each
        above = self.factors.dissection.generations[height].above
        factor, ties = self.factors.factor[height], self.factors.ties[height]
        a = ties.shape[1]
        follows = solve_triangular(factor[node], row[:, :a].T, lower=True).T @ ties[node]
        none = jnp.zeros((LINE, self.within[height + 1].shape[1]))
        return none.at[:, above[node]].add(row[:, a:] - follows, mode="drop")


def marginals(factors: Factors) -> Marginals:
    """From the root, whose unknowns have no border, down to the leaves."""
    d, within = factors.dissection, []
    parents = jnp.zeros((1, 0, 0))
    for generation, factor, ties in reversed(
        list(zip(d.generations, factors.factor, factors.ties, strict=True))
    ):

        def of_node(each: tuple[Array, ...], parents: Array = parents) -> Array:
            L, E, above, node = each
            parent = jnp.pad(parents[node // BRANCH], (0, 1))
            at = jnp.minimum(above, parent.shape[0] - 1)
            border = parent[at][:, at]
            follows = solve_triangular(L, E, lower=True, trans=1)
            to_border = -follows @ border
            own = cho_solve((L, True), jnp.eye(L.shape[0])) - to_border @ follows.T
            return jnp.block([[own, to_border], [to_border.T, border]])

        parents = jax.lax.map(of_node, (factor, ties, generation.above, jnp.arange(len(factor))))
        within.insert(0, parents)
    leaf, at = d.pose
    of_pose = lambda k, at: jax.lax.dynamic_slice(within[0][k], (at, at), (POSE, POSE))
    return Marginals(factors, tuple(within), jax.lax.map(lambda a: of_pose(*a), (leaf, at)))
