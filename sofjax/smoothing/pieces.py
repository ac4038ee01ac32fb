"""A drive cut into pieces, each of which eliminates what concerns no other; the rest is dense.

A piece's own unknowns are its poses, bar the first, and the lines that are seen in it alone. What
is left over are the first poses, the lines seen in several pieces, however far apart, and what all
share.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float, Int

from sofjax.smoothing.blocks import Blocks, Jacobian
from sofjax.smoothing.keyframes import PAD, padded
from sofjax.smoothing.problem import LINE, POSE, SHARED, Keyframes, Unknowns


class Pieces(eqx.Module):
    """Which lines each of the C pieces has for itself, and which are left over."""

    own: Int[Array, "C P"]  # lines that no other piece sees; K: none
    left: Int[Array, "L"]  # lines that several see; K: none
    border: Int[Array, "C Q"]  # places in `left` of those that a piece sees; L: none
    slot: Int[Array, "n M"]  # a segment's line among (own, border) of its piece; P + Q: none

    @property
    def length(self) -> int:
        """Keyframes of a piece."""
        return self.slot.shape[0] // self.own.shape[0]

    @property
    def size(self) -> int:
        """Unknowns left over."""
        return POSE * self.own.shape[0] + LINE * self.left.shape[0] + SHARED

    @property
    def places(self) -> Int[Array, "C q"]:
        """Of what each piece borders on among what is left over; `size`: none.

        Its first pose, the next piece's first pose, its lines, what all share.
        """
        C, L = self.own.shape[0], self.left.shape[0]
        first = POSE * jnp.arange(C)[:, None] + jnp.arange(POSE)
        after = jnp.where(first + POSE < POSE * C, first + POSE, self.size)
        at = POSE * C + LINE * self.border[..., None] + jnp.arange(LINE)
        line = jnp.where(self.border[..., None] < L, at, self.size).reshape(C, -1)
        shared = jnp.broadcast_to(POSE * C + LINE * L + jnp.arange(SHARED), (C, SHARED))
        return jnp.concatenate([first, after, line, shared], axis=1)


def cut(
    keyframes: Keyframes, K: int, length: int | None = None, room: tuple[int, int, int] = (0, 0, 0)
) -> Pieces:
    """By what the keyframes [n] see now; on the host.

    **Arguments:**
    - `K`: the number of lines.
    - `length`: keyframes of a piece, two at least; n is a multiple of it. By default more of them
      in a longer drive: long pieces have more to eliminate, many pieces leave more over.
    - `room`: least P, L and Q, so that what was compiled for them serves again.
    """
    known = np.asarray(keyframes.known)
    line = np.where(known, np.asarray(keyframes.line), K)
    n = len(line)
    length = length or (PAD // 2 if n <= 1024 else PAD)
    C = n // length
    if C * length != n or length < 2:
        raise ValueError(f"{n} keyframes cannot be cut into pieces of {length}")
    piece = np.arange(n)[:, None] // length
    seen = np.zeros((C, K + 1), bool)
    seen[piece, line] = True
    seen = seen[:, :K]
    alone = seen.sum(axis=0) < 2
    home = np.where(seen.any(axis=0), seen.argmax(axis=0), np.arange(K) % C)
    own = _table([np.flatnonzero(alone & (home == i)) for i in range(C)], K, max(32, room[0]))
    left = np.flatnonzero(~alone)
    left = np.append(left, np.full(max(padded(len(left), 128), room[1]) - len(left), K))
    place = np.full(K + 1, len(left))
    place[left] = np.arange(len(left))
    place[K] = len(left)
    border = _table([place[:K][seen[i] & ~alone] for i in range(C)], len(left), max(64, room[2]))
    slot = np.full((C, K + 1), own.shape[1] + border.shape[1])
    for i in range(C):
        slot[i, own[i]] = np.arange(own.shape[1])
        lines = np.append(left, K)[border[i]]
        slot[i, lines] = own.shape[1] + np.arange(border.shape[1])
    slot[:, K] = own.shape[1] + border.shape[1]
    return Pieces(*map(jnp.asarray, (own, left, border, slot[piece, line])))


def _table(rows: list[np.ndarray], none: int, room: int) -> np.ndarray:
    """Rows of one width, `room` at least; what is beyond them is `none`."""
    width = room
    while width < max(map(len, rows)):
        width *= 2
    return np.stack([np.append(row, np.full(width - len(row), none)) for row in rows])


class Reduced(eqx.Module):
    """Normal equations with the pieces' own unknowns eliminated."""

    pieces: Pieces
    factor: Float[Array, "C a a"]  # lower triangular, of the own unknowns
    ties: Float[Array, "C a q"]  # A^-1 E: how the own ones follow what they border on
    rest: Float[Array, "B B"]  # lower triangular, of the Schur complement

    def solve(self, right: Unknowns) -> Unknowns:
        own, rest = _packed(self.pieces, right)
        places, B = self.pieces.places, self.pieces.size
        carried = jnp.einsum("caq,ca->cq", self.ties, own)
        rest = rest - jnp.zeros(B).at[places].add(carried, mode="drop")
        y = jnp.append(cho_solve((self.rest, True), rest), 0)
        x = jax.vmap(lambda L, r: cho_solve((L, True), r))(self.factor, own)
        x = x - jnp.einsum("caq,cq->ca", self.ties, y[places])
        return _unpacked(self.pieces, x, y[:B], right)


def reduce(blocks: Blocks, pieces: Pieces) -> Reduced:
    """Eliminate what each piece has for itself."""
    C, P = pieces.own.shape
    Q, L, B, c = pieces.border.shape[1], pieces.left.shape[0], pieces.size, pieces.length
    with_none = lambda a, none: jnp.concatenate([a, none[None]])
    line = with_none(blocks.line, jnp.eye(LINE))
    line_shared = with_none(blocks.line_shared, jnp.zeros((LINE, SHARED)))
    k, p = jnp.arange(c), jnp.arange(P)
    rows = lambda a, count: a.reshape(count, -1)

    def of_piece(each):
        pose, following, seen, pose_shared, slot, own = each
        D = jnp.zeros((c, POSE, c, POSE)).at[k, :, k, :].set(pose)
        D = D.at[k[:-1], :, k[1:], :].set(following[:-1])
        D = D.at[k[1:], :, k[:-1], :].set(jnp.swapaxes(following[:-1], 1, 2))
        X = jnp.zeros((c, POSE, P + Q + 1, LINE)).at[k[:, None], :, slot].add(seen)
        mine, others = X[:, :, :P], X[:, :, P:-1]
        a, b = POSE * (c - 1), LINE * P
        cross = rows(mine[1:], a)
        alone = jnp.zeros((P, LINE, P, LINE)).at[p, :, p, :].set(line[own]).reshape(b, b)
        A = jnp.block([[D[1:, :, 1:].reshape(a, a), cross], [cross.T, alone]])
        after = jnp.zeros((a, POSE)).at[-POSE:].set(following[-1])
        E_pose = [rows(D[1:, :, 0], a), after, rows(others[1:], a), rows(pose_shared[1:], a)]
        E_line = [rows(mine[0], POSE).T, jnp.zeros((b, POSE + LINE * Q)), rows(line_shared[own], b)]
        E = jnp.concatenate([jnp.concatenate(part, axis=1) for part in (E_pose, E_line)])
        factor = jnp.linalg.cholesky(A)
        ties = cho_solve((factor, True), E)
        # what the first pose ties directly
        first = jnp.zeros((POSE, E.shape[1])).at[:, 2 * POSE : -SHARED].set(rows(others[0], POSE))
        first = first.at[:, -SHARED:].set(pose_shared[0])
        H = (-E.T @ ties).at[:POSE].add(first).at[:, :POSE].add(first.T)
        return factor, ties, H.at[:POSE, :POSE].add(pose[0])

    split = lambda a: a.reshape(C, c, *a.shape[1:])
    factor, ties, H = jax.lax.map(of_piece, (
        split(blocks.pose), split(blocks.next), split(blocks.seen), split(blocks.pose_shared),
        split(pieces.slot), pieces.own,
    ))  # fmt: skip
    places, l = pieces.places, jnp.arange(L)
    at = (places[:, :, None], places[:, None, :])
    S = jnp.zeros((B, B)).at[at].add(H, mode="drop")
    a, b = POSE * C, POSE * C + LINE * L
    diagonal = jnp.zeros((L, LINE, L, LINE)).at[l, :, l, :].set(line[pieces.left])
    to_shared = line_shared[pieces.left].reshape(LINE * L, SHARED)
    S = S.at[a:b, a:b].add(diagonal.reshape(LINE * L, LINE * L))
    S = S.at[a:b, b:].add(to_shared).at[b:, a:b].add(to_shared.T).at[b:, b:].add(blocks.shared)
    return Reduced(pieces, factor, ties, jnp.linalg.cholesky(S))


def _packed(pieces: Pieces, u: Unknowns) -> tuple[Float[Array, "C a"], Float[Array, "B"]]:
    C = pieces.own.shape[0]
    pose = u.pose.reshape(C, -1, POSE)
    line = jnp.concatenate([u.line, jnp.zeros((1, LINE))])
    own = [pose[:, 1:].reshape(C, -1), line[pieces.own].reshape(C, -1)]
    rest = [pose[:, 0].reshape(-1), line[pieces.left].reshape(-1), u.shared]
    return jnp.concatenate(own, axis=1), jnp.concatenate(rest)


def _unpacked(pieces: Pieces, own: Array, rest: Array, like: Unknowns) -> Unknowns:
    C, L, a = pieces.own.shape[0], pieces.left.shape[0], POSE * (pieces.length - 1)
    first = rest[: POSE * C].reshape(C, 1, POSE)
    pose = jnp.concatenate([first, own[:, :a].reshape(C, -1, POSE)], axis=1)
    line = jnp.zeros((like.line.shape[0] + 1, LINE))
    line = line.at[pieces.own].set(own[:, a:].reshape(C, -1, LINE))
    line = line.at[pieces.left].set(rest[POSE * C : -SHARED].reshape(L, LINE))
    return Unknowns(pose.reshape(like.pose.shape), line[:-1], rest[-SHARED:])


class PiecewiseSolver(lx.AbstractLinearSolver):
    """Lineax solver of a (damped) least-squares step of a drive cut into pieces, for optimistix."""

    keyframes: Keyframes
    pieces: Pieces

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
        J = Jacobian.of(lambda v: operator.mv(v)[0], like)
        right, _ = J.transposed(self.keyframes, residual)
        reduced = reduce(J.blocks(self.keyframes, root**2), self.pieces)
        return reduced.solve(right), lx.RESULTS.successful, {}

    def transpose(self, state, options):
        raise NotImplementedError("a least-squares solver has no transpose here")

    def conj(self, state, options):
        return state, options

    def assume_full_rank(self):
        return True
