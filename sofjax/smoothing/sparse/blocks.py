"""The Jacobian and the normal equations block by block, from a few products J v."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sofjax.smoothing.problem import LINE, POSE, SHARED, Keyframes, Residuals, Unknowns


class Blocks(eqx.Module):
    """What is not zero of JᵀJ + damping: an observation ties one pose to one line, the odometer one
    pose to the next, and what all share ties all.
    """

    pose: Float[Array, "n 5 5"]
    next: Float[Array, "n 5 5"]  # between keyframes i and i + 1; the last is zero
    seen: Float[Array, "n M 5 3"]  # between a keyframe and the line of one of its segments
    pose_shared: Float[Array, "n 5 8"]
    line: Float[Array, "K 3 3"]
    line_shared: Float[Array, "K 3 8"]
    shared: Float[Array, "8 8"]
    measured: Float[Array, "K 3 3"]  # information of each line from its observations alone


class Jacobian(eqx.Module):
    """What is not zero of J."""

    pose: Float[Array, "n M 2 5"]  # of the pixels
    line: Float[Array, "n M 2 3"]
    shared: Residuals  # with an axis of 8 behind
    here: Float[Array, "n 3 5"]  # of the odometer, by the pose that it led to ...
    before: Float[Array, "n 3 5"]  # ... and by the one that it came from; the first is zero
    tilt: Float[Array, "n 2 5"]
    prior: Float[Array, "K 3 3"]  # of the lines

    @staticmethod
    def of(mv: Callable[[Unknowns], Residuals], like: Unknowns) -> "Jacobian":
        """Of the operator `mv`, v to J v.

        As no residual knows two keyframes, bar neighbours, nor two lines, one product with ones in
        the same unknown of every other keyframe, or of every line, gives a whole column.
        """
        even = jnp.arange(like.pose.shape[0]) % 2 == 0
        J = jax.vmap(mv, out_axes=-1)(_probes(like, even))  # all at once: one program to compile
        part = lambda a, b: jax.tree.map(lambda v: v[..., a:b], J)
        first, second = part(0, POSE), part(POSE, 2 * POSE)
        line, shared = part(2 * POSE, 2 * POSE + LINE), part(2 * POSE + LINE, None)
        mine = lambda a, b: jnp.where(even.reshape(-1, *[1] * (a.ndim - 1)), a, b)
        before = mine(second.odometer, first.odometer).at[0].set(0)
        return Jacobian(
            pose=mine(first.pixels, second.pixels),
            line=line.pixels,
            shared=shared,
            here=mine(first.odometer, second.odometer),
            before=before,
            tilt=mine(first.tilt, second.tilt),
            prior=line.line,
        )

    def transposed(self, keyframes: Keyframes, r: Residuals) -> tuple[Unknowns, Array]:
        """Jᵀ r, and the part [K, 3] of it that the lines have from what was seen of them."""
        pose = (
            jnp.einsum("nmri,nmr->ni", self.pose, r.pixels)
            + jnp.einsum("nri,nr->ni", self.here, r.odometer)
            + jnp.einsum("nri,nr->ni", self.tilt, r.tilt)
        )
        pose = pose.at[:-1].add(jnp.einsum("nri,nr->ni", self.before, r.odometer)[1:])
        measured = self._by_line(keyframes, jnp.einsum("nmri,nmr->nmi", self.line, r.pixels))
        line = measured + jnp.einsum("kri,kr->ki", self.prior, r.line)
        shared = (
            jnp.einsum("nmrg,nmr->g", self.shared.pixels, r.pixels)
            + jnp.einsum("nrg,nr->g", self.shared.odometer, r.odometer)
            + self.shared.shared.T @ r.shared
        )
        return Unknowns(pose, line, shared), measured

    def blocks(self, keyframes: Keyframes, damping: Float[Array, ""] | float) -> Blocks:
        """Of JᵀJ + damping."""
        P, L, G = self.pose, self.line, self.shared
        O, Q, T, R = self.here, self.before, self.tilt, self.prior
        pose = (
            jnp.einsum("nmri,nmrj->nij", P, P)
            + jnp.einsum("nri,nrj->nij", O, O)
            + jnp.einsum("nri,nrj->nij", T, T)
            + damping * jnp.eye(POSE)
        )
        pose = pose.at[:-1].add(jnp.einsum("nri,nrj->nij", Q, Q)[1:])
        following = jnp.zeros_like(pose).at[:-1].set(jnp.einsum("nri,nrj->nij", Q, O)[1:])
        pose_shared = jnp.einsum("nmri,nmrg->nig", P, G.pixels)
        pose_shared = pose_shared + jnp.einsum("nri,nrg->nig", O, G.odometer)
        pose_shared = pose_shared.at[:-1].add(jnp.einsum("nri,nrg->nig", Q, G.odometer)[1:])
        measured = self._by_line(keyframes, jnp.einsum("nmri,nmrj->nmij", L, L))
        shared = (
            jnp.einsum("nmrg,nmrh->gh", G.pixels, G.pixels)
            + jnp.einsum("nrg,nrh->gh", G.odometer, G.odometer)
            + G.shared.T @ G.shared
            + damping * jnp.eye(SHARED)
        )
        return Blocks(
            pose=pose,
            next=following,
            seen=jnp.einsum("nmri,nmrj->nmij", P, L),
            pose_shared=pose_shared,
            line=measured + jnp.einsum("kri,krj->kij", R, R) + damping * jnp.eye(LINE),
            line_shared=self._by_line(keyframes, jnp.einsum("nmri,nmrg->nmig", L, G.pixels)),
            shared=shared,
            measured=measured,
        )

    def _by_line(self, keyframes: Keyframes, a: Array) -> Array:
        K = self.prior.shape[0]
        index = jnp.where(keyframes.known, keyframes.line, K).reshape(-1)
        return jax.ops.segment_sum(a.reshape(-1, *a.shape[2:]), index, K + 1)[:K]


def _probes(like: Unknowns, even: Bool[Array, "n"]) -> Unknowns:
    """Ones in each unknown of the even poses, of the odd ones, of all lines, and in each shared."""
    eye = jnp.eye(2 * POSE + LINE + SHARED)
    a, b, c, d = jnp.split(eye, [POSE, 2 * POSE, 2 * POSE + LINE], axis=1)
    pose = jnp.where(even[:, None], a[:, None], b[:, None])
    line = jnp.broadcast_to(c[:, None], (len(eye), *like.line.shape))
    return eqx.tree_at(lambda u: (u.pose, u.line, u.shared), like, (pose, line, d))
