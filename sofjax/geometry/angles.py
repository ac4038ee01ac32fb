"""Angles, and norms whose gradient is finite at zero."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def wrap(angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The same direction in [-pi, pi], radians."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def wrap_axial(angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The same undirected direction (modulo pi) in [-pi/2, pi/2], radians."""
    return angle - jnp.pi * jnp.round(angle / jnp.pi)


def safe_sqrt(value: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Square root, and zero (with zero gradient) where the value is not positive."""
    positive = value > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, value, 1)), 0)


def safe_norm(vector: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Euclidean norm; its gradient at the zero vector is zero where `jnp.linalg.norm` gives NaN."""
    return safe_sqrt(jnp.sum(vector**2, axis=-1))


def safe_divide(
    numerator: Float[Array, "*#shape"], denominator: Float[Array, "*#shape"]
) -> Float[Array, "*#shape"]:
    """The quotient, and zero (with zero gradient) where the denominator is zero."""
    defined = denominator != 0
    return jnp.where(defined, numerator / jnp.where(defined, denominator, 1), 0)


def safe_arctan2(y: Float[Array, "*shape"], x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """`arctan2`, and zero (with zero gradient) at the origin."""
    defined = (x != 0) | (y != 0)
    return jnp.where(defined, jnp.arctan2(y, jnp.where(defined, x, 1)), 0)
