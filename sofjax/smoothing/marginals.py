"""How sure a solution is: covariances of its poses and lines, and of two lines with each other."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Float, Int

from sofjax.smoothing.dissection import BRANCH
from sofjax.smoothing.elimination import Factors
from sofjax.smoothing.problem import LINE, POSE, SHARED


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

    def of_lines(self, i: Int[Array, "pairs"], j: Int[Array, "pairs"]) -> Float[Array, "pairs 3 3"]:
        """Between lines i and j.

        Each is followed up the tree, as a combination of what ever higher nodes border on, to the
        lowest node above both.
        """
        d = self.factors.dissection
        leaf, place = d.line
        start = jnp.zeros((LINE, self.within[0].shape[1]))
        itself = lambda k: start.at[:, place[k] + jnp.arange(LINE)].set(jnp.eye(LINE))

        def of_pair(pair):
            rows, nodes = [itself(k) for k in pair], [leaf[k] for k in pair]
            found, met = jnp.zeros((LINE, LINE)), jnp.array(False)
            for height in range(len(d.generations)):
                meet = (nodes[0] == nodes[1]) & ~met
                between = partial(_between, self.within[height])
                found = jax.lax.cond(meet, between, lambda *same: same[-1], *rows, nodes[0], found)
                met = met | meet
                if height + 1 < len(d.generations):
                    rows = [
                        self._lifted(height, row, k, met)
                        for row, k in zip(rows, nodes, strict=True)
                    ]
                    nodes = [k // BRANCH for k in nodes]
            return found

        return jax.lax.map(of_pair, (i, j))

    def _lifted(self, height, row, node, useless):
        """A combination of what a node knows as one of what its parent knows, if that is of use."""
        above = self.factors.dissection.generations[height].above
        factor, ties = self.factors.factor[height], self.factors.ties[height]
        none, a = jnp.zeros((LINE, self.within[height + 1].shape[1])), ties.shape[1]

        def lifted(row, k):
            follows = solve_triangular(factor[k], row[:, :a].T, lower=True).T @ ties[k]
            border = row[:, a:] - follows
            return none.at[:, above[k]].add(border, mode="drop")

        return jax.lax.cond(useless, lambda *_: none, lifted, row, node)


def _between(within, first, second, node, _):
    return first @ within[node] @ second.T


def marginals(factors: Factors) -> Marginals:
    """From the root, whose unknowns have no border, down to the leaves."""
    d, within = factors.dissection, []
    parents = jnp.zeros((1, 0, 0))
    for generation, factor, ties in reversed(
        list(zip(d.generations, factors.factor, factors.ties, strict=True))
    ):

        def of_node(each, parents=parents):
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
