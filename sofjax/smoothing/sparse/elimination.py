"""Cholesky's factors of the normal equations, node by node of a dissection: the multifrontal way.

A node has a small dense matrix of the unknowns that it eliminates and of those that they are tied
to; what elimination makes of the latter is added to the matrix of its parent. Duff and Reid, The
multifrontal solution of indefinite sparse symmetric linear equations (1983).
"""

from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int

from sofjax.smoothing.problem import LINE, POSE, SHARED, Keyframes, Unknowns
from sofjax.smoothing.sparse.blocks import Blocks, Jacobian
from sofjax.smoothing.sparse.dissection import BRANCH, Dissection


class Factors(eqx.Module):
    """By generation, from the leaves to the root, of N nodes each."""

    dissection: Dissection
    factor: tuple[Float[Array, "_ _ _"], ...]  # [N, a, a] lower triangular, of what is eliminated
    ties: tuple[Float[Array, "_ _ _"], ...]  # [N, a, q] L^-1 E, of what ties that to the border

    def solve(self, right: Unknowns) -> Unknowns:
        r = jnp.concatenate([part.reshape(-1) for part in (right.pose, right.line, right.shared)])
        steps = list(zip(self.dissection.generations, self.factor, self.ties, strict=True))
        down = jax.vmap(lambda L, b: solve_triangular(L, b, lower=True))
        up = jax.vmap(lambda L, b: solve_triangular(L, b, lower=True, trans=1))
        for nodes, factor, ties in steps:
            own = down(factor, r.at[nodes.own].get(mode="fill", fill_value=0))
            r = r.at[nodes.own].set(own, mode="drop")
            r = r.at[nodes.border].add(-jnp.einsum("naq,na->nq", ties, own), mode="drop")
        for nodes, factor, ties in reversed(steps):
            own = r.at[nodes.own].get(mode="fill", fill_value=0)
            border = r.at[nodes.border].get(mode="fill", fill_value=0)
            own = up(factor, own - jnp.einsum("naq,nq->na", ties, border))
            r = r.at[nodes.own].set(own, mode="drop")
        pose, line, shared = jnp.split(r, [right.pose.size, right.pose.size + right.line.size])
        return Unknowns(pose.reshape(right.pose.shape), line.reshape(right.line.shape), shared)


def _condense(
    F: Float[Array, "f f"], own: Int[Array, "a"], size: int
) -> tuple[Array, Array, Array]:
    """The pivot block's factor, its ties to the front, and the front without it."""
    a = own.shape[0]
    A = F[:a, :a] + jnp.diag((own == size).astype(F.dtype))
    factor = jnp.linalg.cholesky(A, symmetrize_input=False)
    ties = solve_triangular(factor, F[:a, a:], lower=True)
    return factor, ties, F[a:, a:] - ties.T @ ties


def eliminate(blocks: Blocks, dissection: Dissection) -> Factors:
    """From the leaves to the root."""
    leaves, generations = dissection.leaves, dissection.generations

    with_none = lambda a: jnp.concatenate([a, jnp.zeros((1, *a.shape[1:]), a.dtype)])
    seen = blocks.seen.reshape(-1, POSE, LINE)
    pose, seen, pose_shared, line, line_shared = map(
        with_none, (blocks.pose, seen, blocks.pose_shared, blocks.line, blocks.line_shared)
    )
    # of a pose with the one before it; the last of `next` is zero
    following = jnp.concatenate([blocks.next[-1:], blocks.next[:-1], blocks.next[-1:]])
    width = sum(generations[0].own.shape[1:] + generations[0].border.shape[1:])
    plus = lambda start, count: start[..., None] + jnp.arange(count)

    def of_leaf(each: tuple) -> tuple[Array, Array, Array]:
        leaf, own, is_first = each
        i, k = leaf.frame, leaf.line
        poses, mine = plus(leaf.here, POSE), plus(leaf.line_at, LINE)  # [c, 5] and [P, 3]
        shared = plus(leaf.shared, SHARED)
        F = jnp.zeros((width, width))
        for rows, columns, value in (
            (poses, poses, pose[i] / 2),
            (plus(leaf.before, POSE), poses, following[i]),
            (plus(leaf.by_pose, POSE), plus(leaf.by_line, LINE), seen[leaf.measurement]),
            (poses, shared, pose_shared[i]),
            (mine, mine, line[k] / 2),
            (mine, shared, line_shared[k]),
            (shared, shared, blocks.shared / 2 * is_first),  # counts but once
        ):
            rows, columns = rows[..., :, None], columns[..., None, :]
            F = F.at[rows, columns].add(value, mode="drop")
            F = F.at[columns, rows].add(value, mode="drop")
        return _condense(F, own, dissection.size)

    def of_node(each: tuple) -> tuple[Array, Array, Array]:
        own, border, above, below = each
        width = own.shape[0] + border.shape[0]
        F = jnp.zeros((width, width))
        for at, H in zip(above, below, strict=True):
            q = at.shape[0]
            place = jnp.full(width, q).at[at].set(jnp.arange(q), mode="drop")
            H = jnp.pad(H, (0, 1))
            F = F + H[place][:, place]
        return _condense(F, own, dissection.size)

    is_first = jnp.arange(leaves.frame.shape[0]) == 0
    found = jax.lax.map(of_leaf, (leaves, generations[0].own, is_first.astype(pose.dtype)))
    factors, ties = [found[0]], [found[1]]
    for children, nodes in pairwise(generations):
        by_parent = lambda a: a.reshape(-1, BRANCH, *a.shape[1:])
        found = jax.lax.map(
            of_node, (nodes.own, nodes.border, by_parent(children.above), by_parent(found[2]))
        )
        factors.append(found[0])
        ties.append(found[1])
    return Factors(dissection, tuple(factors), tuple(ties))


class DissectionSolver(lx.AbstractLinearSolver):
    """Lineax solver of a (damped) least-squares step of a whole drive, for optimistix."""

    keyframes: Keyframes
    dissection: Dissection

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> Any:
        return operator

    def compute(
        self, state: Any, vector: Any, options: dict[str, Any]
    ) -> tuple[Unknowns, lx.RESULTS, dict[str, Any]]:
        operator = state
        residual, _ = vector
        like = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), operator.in_structure())
        # the damped operator returns (J v, sqrt(damping) v)
        root = operator.mv(eqx.tree_at(lambda u: u.shared, like, like.shared.at[0].set(1.0)))[
            1
        ].shared[0]
        J = Jacobian.of(lambda v: operator.mv(v)[0], like)
        right, _ = J.transposed(self.keyframes, residual)
        factors = eliminate(J.blocks(self.keyframes, root**2), self.dissection)
        return factors.solve(right), lx.RESULTS.successful, {}

    def transpose(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        raise NotImplementedError("a least-squares solver has no transpose here")

    def conj(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state, options

    def assume_full_rank(self) -> bool:
        return True
