"""Trees of padded arrays, whose tail is usually padding, and trees in double precision."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, PyTree

Tree = TypeVar("Tree")


def half_if_enough(f: Callable[[PyTree], PyTree], rows: PyTree, there: Bool[Array, "M"]) -> PyTree:
    """f(rows), computed from their first half where the second is padding.

    **Arguments:**
    - `f`: what it returns must not depend on rows that hold nothing, nor have rows itself.
    - `rows`: leaves [M, ...].
    - `there`: which of them hold anything.
    """
    half = -(-there.shape[0] // 2)
    first = jax.tree.map(lambda a: a[:half], rows)
    return jax.lax.cond(in_any_run(there[half:].any()), lambda: f(rows), lambda: f(first))


@jax.custom_batching.custom_vmap
def in_any_run(condition: Bool[Array, ""]) -> Bool[Array, ""]:
    """The condition; under `vmap` whether it holds in any run of the batch.

    What a `cond` may pass over is then passed over in batches too, as long as all can: by a
    condition of each, `vmap` would have it work out both.
    """
    return condition


@in_any_run.def_vmap
def _of_batch(
    axis_size: int, in_batched: list[bool], condition: Bool[Array, "batch"]
) -> tuple[Bool[Array, ""], bool]:
    return in_any_run(condition.any()), False


def float_of(number: ArrayLike) -> ArrayLike:
    """A scalar as Python's own number, which takes the precision of what it meets."""
    return np.asarray(number).item()


def in_double(tree: Tree) -> Tree:
    """The tree with its floating point leaves in float64; to be called where x64 is enabled."""

    def one(leaf: ArrayLike) -> Array:
        leaf = np.asarray(leaf)
        return jnp.asarray(leaf, float if leaf.dtype.kind == "f" else leaf.dtype)

    return jax.tree.map(one, tree)
