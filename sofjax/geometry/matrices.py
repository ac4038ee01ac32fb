"""Many small matrices at once."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def inverse_2x2(S: Float[Array, "*batch 2 2"]) -> Float[Array, "*batch 2 2"]:
    """Inverse of 2×2 matrices, written out: they come by the thousand."""
    a, b, c, d = S[..., 0, 0], S[..., 0, 1], S[..., 1, 0], S[..., 1, 1]
    rows = jnp.stack([jnp.stack([d, -b], -1), jnp.stack([-c, a], -1)], -2)
    return rows / (a * d - b * c)[..., None, None]


def determinant_2x2(S: Float[Array, "*batch 2 2"]) -> Float[Array, "*batch"]:
    return S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0]
