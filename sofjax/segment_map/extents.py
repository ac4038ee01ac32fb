"""How far along their lines segments reach."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax.geometry.angles import safe_sqrt
from sofjax.geometry.lines import PolarLine, direction, normal, polar_through


def together_at(slot: Int[Array, "M"], K: int) -> Bool[Array, "M M"]:
    """[M, M] Which measurements go to the same slot; K for none."""
    return (slot == slot[:, None]) & (slot < K)


def within(
    endpoints_nadir: Float[Array, "2 2"], radius: Float[Array, ""] | float
) -> tuple[Float[Array, "2 2"], Bool[Array, ""]]:
    """The part of a segment within a disc about the nadir, and whether there is any."""
    line = polar_through(endpoints_nadir)
    d, n = direction(line), normal(line)
    half = safe_sqrt(radius**2 - line.rho**2)
    along = jnp.clip(endpoints_nadir @ d, -half, half)
    return line.rho * n + along[:, None] * d, (half > 0) & (along[0] != along[1])


def spanned(
    line: PolarLine,
    old: Float[Array, "M 2 2"],
    new: Float[Array, "M 2 2"],
    together: Bool[Array, "M M"],
) -> Float[Array, "M 2 2"]:
    """End points on each line that span its old ones and all new ones that go with it."""
    n, d = normal(line), direction(line)
    along, t = (jnp.einsum("mij,mj->mi", ends, d) for ends in (old, new))
    low = jnp.where(together, t.min(axis=1)[:, None], jnp.inf).min(axis=0)
    high = jnp.where(together, t.max(axis=1)[:, None], -jnp.inf).max(axis=0)
    reach = jnp.minimum(along.min(axis=1), low), jnp.maximum(along.max(axis=1), high)
    return line.rho[:, None, None] * n[:, None] + jnp.stack(reach, 1)[..., None] * d[:, None]
