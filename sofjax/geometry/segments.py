"""Segments: padded arrays of end points with a mask; section II.A."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from sofjax.geometry.angles import safe_divide, safe_norm
from sofjax.geometry.se2 import SE2


class Segments(eqx.Module):
    """Segments of one frame, named by the variable: `_image` in pixels, `_world` in metres.

    Where `valid` is false the end points are padding: finite, and without meaning.
    """

    endpoints: Float[Array, "*batch 2 2"]
    valid: Bool[Array, "*batch"]

    @staticmethod
    def of(endpoints: ArrayLike | list[Any]) -> "Segments":
        """Segments from end points [*batch, 2, 2], all of them valid."""
        ends = jnp.asarray(endpoints, float)
        return Segments(ends, jnp.ones(ends.shape[:-2], bool))

    def transform(self, T_a_b: SE2) -> "Segments":
        """Segments of frame b in frame a."""
        return Segments(T_a_b.apply(self.endpoints), self.valid)

    @property
    def length(self) -> Float[Array, "*batch"]:
        return safe_norm(self.endpoints[..., 1, :] - self.endpoints[..., 0, :])


def unit(endpoints: Float[Array, "*batch 2 2"]) -> Float[Array, "*batch 2"]:
    """The unit vector from the first end to the second; zero if there is no length."""
    d = endpoints[..., 1, :] - endpoints[..., 0, :]
    return safe_divide(d, safe_norm(d)[..., None])


def overlap(
    first: Float[Array, "*#batch 2 2"], second: Float[Array, "*#batch 2 2"]
) -> Float[Array, "*batch"]:
    """Length that two segments share along the direction of the second; text below eq. (9).

    Negative is the gap between them; zero if the second has no length. In numbers and not as
    products of matrices, which would not fuse where batches are broadcast to all pairs.
    """
    d = unit(second)
    along = lambda x: x[..., 0] * d[..., 0] + x[..., 1] * d[..., 1]
    a0, a1, b0, b1 = (along(ends[..., i, :]) for ends in (first, second) for i in (0, 1))
    lesser = lambda a, b: jnp.where(a < b, a, b)  # `minimum` also looks for NaN, in every pair
    greater = lambda a, b: jnp.where(a < b, b, a)
    low = greater(lesser(a0, a1), lesser(b0, b1))
    return lesser(greater(a0, a1), greater(b0, b1)) - low


def clip(
    segment: Float[Array, "2 2"], above: Float[Array, "2"]
) -> tuple[Float[Array, "2 2"], Bool[Array, ""]]:
    """The part of a segment on which an affine function is not negative.

    **Arguments:**
    - `segment`: two end points.
    - `above`: the function's values at them.

    **Returns:** the part, in the same direction, and whether it has any length. Where it has
    none the segment comes back as it was.
    """
    f0, f1 = above
    cross = jnp.clip(safe_divide(f0, f0 - f1), 0, 1)
    zero = segment[0] + cross * (segment[1] - segment[0])
    some = (f0 > 0) | (f1 > 0)
    first = jnp.where(some & (f0 < 0), zero, segment[0])
    second = jnp.where(some & (f1 < 0), zero, segment[1])
    return jnp.stack([first, second]), some
