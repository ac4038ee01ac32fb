"""How sure a solution is: covariances of its poses and lines, and of two lines with each other."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float, Int

from sofjax.smoothing.pieces import Pieces, Reduced
from sofjax.smoothing.problem import LINE, POSE, SHARED


class Marginals(eqx.Module):
    """Parts of the inverse of the normal equations."""

    pieces: Pieces
    rest: Float[Array, "B B"]  # of what is left over
    ties: Float[Array, "C P 3 q"]  # of the pieces' own lines
    own: Float[Array, "C P 3 P 3"]  # what they would have if all that they border on were known
    pose: Float[Array, "n 5 5"]

    @property
    def shared(self) -> Float[Array, "8 8"]:
        return self.rest[-SHARED:, -SHARED:]

    def of_lines(
        self, i: Int[Array, "pairs"], j: Int[Array, "pairs"], K: int
    ) -> Float[Array, "pairs 3 3"]:
        """Between lines i and j, each of K."""
        pieces, B = self.pieces, self.rest.shape[0]
        C, P = pieces.own.shape
        L, q = pieces.left.shape[0], self.ties.shape[-1]
        table = lambda value, at, none: jnp.full(K + 1, none).at[at].set(value)[:K]
        home = table(jnp.arange(C * P).reshape(C, P), pieces.own, -1)
        place = table(jnp.arange(L), pieces.left, 0)
        places, R = pieces.places, jnp.pad(self.rest, (0, 1))
        itself = jnp.zeros((LINE, q)).at[jnp.arange(LINE), jnp.arange(LINE)].set(1)

        def follows(k):
            """Rows by which a line follows what is left over, and the places of that."""
            piece, p = jnp.divmod(jnp.maximum(home[k], 0), P)
            at = jnp.full(q, B).at[:LINE].set(POSE * C + LINE * place[k] + jnp.arange(LINE))
            mine = home[k] >= 0
            return jnp.where(mine, -self.ties[piece, p], itself), jnp.where(
                mine, places[piece], at
            ), mine, piece, p  # fmt: skip

        def of_pair(pair):
            (F, at, mine, piece, p), (G, there, yours, other, r) = map(follows, pair)
            together = F @ R[at[:, None], there[None, :]] @ G.T
            same = mine & yours & (piece == other)
            return together + jnp.where(same, self.own[piece, p, :, r, :], 0)

        return jax.lax.map(of_pair, (i, j), batch_size=16)


def marginals(reduced: Reduced) -> Marginals:
    pieces, B = reduced.pieces, reduced.pieces.size
    C, P, c = *pieces.own.shape, pieces.length
    a = POSE * (c - 1)
    rest = cho_solve((reduced.rest, True), jnp.eye(B))
    R = jnp.pad(rest, (0, 1))
    k = jnp.arange(c - 1)

    def of_piece(each):
        factor, ties, places = each
        alone = cho_solve((factor, True), jnp.eye(len(factor)))
        poses = ties[:a] @ R[places[:, None], places[None, :]] @ ties[:a].T + alone[:a, :a]
        blocks = poses.reshape(c - 1, POSE, c - 1, POSE)[k, :, k, :]
        first = R[places[:POSE, None], places[None, :POSE]]
        return jnp.concatenate([first[None], blocks]), alone[a:, a:]

    pose, own = jax.lax.map(of_piece, (reduced.factor, reduced.ties, pieces.places))
    return Marginals(
        pieces,
        rest,
        reduced.ties[:, a:].reshape(C, P, LINE, -1),
        own.reshape(C, P, LINE, P, LINE),
        pose.reshape(-1, POSE, POSE),
    )
