"""Normal equations of the arrow shape: poses in a band, a dense border of all else."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from sofjax.smoothing.problem import LINE, POSE, SHARED, Keyframes, Unknowns


class Arrow(eqx.Module):
    """Normal equations of the arrow shape: block-tridiagonal poses, a dense border of all else.

    The border is every line's unknowns, one line after the other, and the shared ones.
    """

    diagonal: Float[Array, "n 5 5"]
    upper: Float[Array, "n 5 5"]  # between keyframes i and i + 1; the last is zero
    border: Float[Array, "n 5 B"]
    corner: Float[Array, "B B"]
    line: Float[Array, "K 3 3"]  # information of each line from its observations alone

    def solve_poses(self, right: Float[Array, "n 5 R"]) -> Float[Array, "n 5 R"]:
        """Block-tridiagonal elimination down and substitution up."""

        def down(carry, row):
            pivot_before, upper_before, right_before = carry
            diagonal, upper, right = row
            factor = jnp.linalg.solve(pivot_before, upper_before).T
            pivot = diagonal - factor @ upper_before
            right = right - factor @ right_before
            return (pivot, upper, right), (pivot, right)

        blank = (jnp.eye(POSE), jnp.zeros((POSE, POSE)), jnp.zeros(right.shape[1:]))
        _, (pivot, swept) = jax.lax.scan(down, blank, (self.diagonal, self.upper, right))

        def up(after, row):
            pivot, upper, right = row
            x = jnp.linalg.solve(pivot, right - upper @ after)
            return x, x

        _, x = jax.lax.scan(
            up, jnp.zeros(right.shape[1:]), (pivot, self.upper, swept), reverse=True
        )
        return x

    def reduce(self) -> tuple[Float[Array, "n 5 B"], Float[Array, "B B"]]:
        """A^-1 E, and the Schur complement D - Eᵀ A^-1 E."""
        Z = self.solve_poses(self.border)
        flat = lambda a: a.reshape(-1, a.shape[-1])
        return Z, self.corner - flat(self.border).T @ flat(Z)

    def solve(self, pose: Float[Array, "n 5"], rest: Float[Array, "B"]) -> tuple[Array, Array]:
        Z, S = self.reduce()
        flat = Z.reshape(-1, Z.shape[-1])
        y = jax.scipy.linalg.solve(S, rest - flat.T @ pose.reshape(-1), assume_a="pos")
        x = self.solve_poses(pose[..., None])[..., 0]
        return x - (flat @ y).reshape(pose.shape), y

    def diagonal_of_inverse(self) -> Float[Array, "n 5 5"]:
        """Diagonal blocks of the band's inverse, by sweeps from both ends."""

        def down(carry, row):
            pivot_before, upper_before = carry
            diagonal, upper = row
            pivot = diagonal - upper_before.T @ jnp.linalg.solve(pivot_before, upper_before)
            return (pivot, upper), pivot

        blank = (jnp.eye(POSE), jnp.zeros((POSE, POSE)))
        _, forward = jax.lax.scan(down, blank, (self.diagonal, self.upper))

        def up(pivot_after, row):
            diagonal, upper = row
            pivot = diagonal - upper @ jnp.linalg.solve(pivot_after, upper.T)
            return pivot, pivot

        _, backward = jax.lax.scan(up, jnp.eye(POSE), (self.diagonal, self.upper), reverse=True)
        return jnp.linalg.inv(forward + backward - self.diagonal)


def assemble(mv, keyframes: Keyframes, like: Unknowns, damping: Float[Array, ""] | float) -> Arrow:
    """Normal equations JᵀJ + damping of an operator of the arrow shape, from a few products J v.

    As no residual knows two keyframes, bar neighbours, nor two lines, one product with ones in the
    same unknown of every other keyframe, or of every line, gives a whole column of all blocks.
    """
    n, K = like.pose.shape[0], like.line.shape[0]
    even = jnp.arange(n) % 2 == 0
    column = jax.vmap(mv, out_axes=-1)  # all products at once: one program to compile
    zero = jax.tree.map(jnp.zeros_like, like)
    ones = lambda a: jnp.moveaxis(
        jnp.broadcast_to(jnp.eye(a.shape[-1]), (*a.shape, a.shape[-1])), -1, 0
    )
    probe = lambda where, value: column(_probes(zero, where, value))
    of_pose = lambda mask: probe(lambda u: u.pose, jnp.where(mask[:, None], ones(like.pose), 0.0))
    first, second = of_pose(even), of_pose(~even)
    mine = lambda a, b: jnp.where(even.reshape(-1, *[1] * (a.ndim - 1)), a, b)
    P, T = mine(first.pixels, second.pixels), mine(first.tilt, second.tilt)
    O = mine(first.odometer, second.odometer)  # residual i by pose i ...
    Q = mine(second.odometer, first.odometer).at[0].set(0)  # ... and by pose i - 1
    of_line = probe(lambda u: u.line, ones(like.line))
    L, R = of_line.pixels, of_line.line  # [n, M, 2, 3] and [K, 3, 3]
    G = probe(lambda u: u.shared, ones(like.shared))

    diagonal = (
        jnp.einsum("nmri,nmrj->nij", P, P)
        + jnp.einsum("nri,nrj->nij", O, O)
        + jnp.einsum("nri,nrj->nij", T, T)
        + damping * jnp.eye(POSE)
    )
    QQ = jnp.einsum("nri,nrj->nij", Q, Q)
    diagonal = diagonal.at[:-1].add(QQ[1:])
    QO = jnp.einsum("nri,nrj->nij", Q, O)
    upper = jnp.zeros((n, POSE, POSE)).at[:-1].set(QO[1:])

    index = jnp.where(keyframes.known, keyframes.line, K)
    cross = jnp.einsum("nmri,nmrj->nmij", P, L)  # [n, M, 5, 3]
    to_line = jnp.zeros((n, K + 1, POSE, LINE)).at[jnp.arange(n)[:, None], index].add(cross)[:, :K]
    to_line = jnp.moveaxis(to_line, 1, 2).reshape(n, POSE, K * LINE)
    to_shared = jnp.einsum("nmri,nmrg->nig", P, G.pixels) + jnp.einsum(
        "nri,nrg->nig", O, G.odometer
    )
    to_shared = to_shared.at[:-1].add(jnp.einsum("nri,nrg->nig", Q, G.odometer)[1:])
    border = jnp.concatenate([to_line, to_shared], axis=2)

    by_line = lambda a: jax.ops.segment_sum(a.reshape(-1, *a.shape[2:]), index.reshape(-1), K + 1)[
        :K
    ]
    line = by_line(jnp.einsum("nmri,nmrj->nmij", L, L))
    whole = line + jnp.einsum("kri,krj->kij", R, R) + damping * jnp.eye(LINE)
    line_shared = by_line(jnp.einsum("nmri,nmrg->nmig", L, G.pixels)).reshape(K * LINE, SHARED)
    shared = (
        jnp.einsum("nmrg,nmrh->gh", G.pixels, G.pixels)
        + jnp.einsum("nrg,nrh->gh", G.odometer, G.odometer)
        + jnp.einsum("rg,rh->gh", G.shared, G.shared)
        + damping * jnp.eye(SHARED)
    )
    B = K * LINE + SHARED
    k = jnp.arange(K)
    blocks = jnp.zeros((K, LINE, K, LINE)).at[k, :, k, :].set(whole).reshape(K * LINE, K * LINE)
    corner = jnp.zeros((B, B)).at[: K * LINE, : K * LINE].set(blocks)
    corner = corner.at[: K * LINE, K * LINE :].set(line_shared)
    corner = (
        corner.at[K * LINE :, : K * LINE].set(line_shared.T).at[K * LINE :, K * LINE :].set(shared)
    )
    return Arrow(diagonal, upper, border, corner, line)


def _probes(zero: Unknowns, where, value) -> Unknowns:
    """As many unknowns as `value` has, which are zero but for one part."""
    batch = jax.tree.map(lambda a: jnp.broadcast_to(a, (value.shape[0], *a.shape)), zero)
    return eqx.tree_at(where, batch, value)


class ArrowSolver(lx.AbstractLinearSolver):
    """Lineax solver of a (damped) least-squares step of the arrow shape, for optimistix."""

    keyframes: Keyframes

    def init(self, operator, options):
        return operator

    def compute(self, state, vector, options):
        operator = state
        residual, _ = vector
        like = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), operator.in_structure())
        # the damped operator returns (J v, sqrt(damping) v)
        root = operator.mv(eqx.tree_at(lambda u: u.shared, like, like.shared.at[0].set(1.0)))[
            1
        ].shared[0]
        arrow = assemble(lambda v: operator.mv(v)[0], self.keyframes, like, root**2)
        transpose = operator.transpose()
        g = transpose.mv((residual, like))
        pose, rest = arrow.solve(g.pose, jnp.concatenate([g.line.reshape(-1), g.shared]))
        K = like.line.shape[0]
        step = Unknowns(pose, rest[: K * LINE].reshape(K, LINE), rest[K * LINE :])
        return step, lx.RESULTS.successful, {}

    def transpose(self, state, options):
        raise NotImplementedError("a least-squares solver has no transpose here")

    def conj(self, state, options):
        return state, options

    def assume_full_rank(self):
        return True
