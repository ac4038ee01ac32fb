"""The least-squares solution and how sure it is."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from sofjax.segment_map import on_floor
from sofjax.smoothing.problem import Problem, Residuals, Unknowns, residuals
from sofjax.smoothing.sparse.blocks import Jacobian
from sofjax.smoothing.sparse.dissection import Dissection, dissect, divide
from sofjax.smoothing.sparse.elimination import DissectionSolver, eliminate
from sofjax.smoothing.sparse.marginals import Marginals, marginals

TOLERANCE = 1e-4  # metres and radians
MISFIT = 1e-3  # standard deviations, root mean square, by which it changes the residuals


def _norm(scaled: Unknowns | Residuals) -> Float[Array, ""]:
    """By which a step is small if it is below one; a line that hardly anybody sees may wander on
    without moving any pose.
    """
    if isinstance(scaled, Unknowns):
        return jnp.maximum(jnp.abs(scaled.pose).max(), jnp.abs(scaled.shared).max())
    flat = jnp.concatenate([part.reshape(-1) for part in jax.tree.leaves(scaled)])
    return TOLERANCE / MISFIT * jnp.sqrt(jnp.mean(flat**2))


class Solution(eqx.Module):
    """The estimate and how sure it is."""

    unknowns: Unknowns
    cost_before: Float[Array, ""]  # half the sum of squared residuals
    cost: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]
    marginals: Marginals
    scale_free: Float[
        Array, "K"
    ]  # each line's apparent scale if it alone were free, poses held ...
    scale_sigma: Float[Array, "K"]  # ... and its standard deviation
    on_floor: Float[Array, "K 3"]  # each line if it alone were free, but on the floor

    @property
    def pose_covariance(self) -> Float[Array | np.ndarray, "n 5 5"]:
        return self.marginals.pose


def _cost(r: Residuals) -> Float[Array, ""]:
    parts = [jnp.sum(part**2) for part in jax.tree.leaves(r)]
    return 0.5 * sum(parts[1:], start=parts[0])


def solve(
    problem: Problem,
    dissection: Dissection | None = None,
    max_steps: int = 60,
    sure: bool = True,
    tolerance: float = TOLERANCE,
) -> Solution:
    """Levenberg-Marquardt from `problem.start`. Expects float64; see `jax.enable_x64`.

    **Arguments:**
    - `dissection`: of `dissect`, which is asked if it is not given; it needs numbers, not tracers.
    - `sure`: whether the covariances are wanted; they cost as much as some steps.
    - `tolerance`: metres and radians, of the last step of any pose.

    **Returns:** the estimate with marginal covariances, or zeros for them. `converged` is false
    where `max_steps` did not suffice; the estimate is then the best so far.
    """
    if dissection is None:
        start = problem.start
        leaf = divide(np.asarray(start.pose[:, :2]))
        dissection = dissect(problem.keyframes, start.line.shape[0], leaf)
    return _solve(problem, dissection, max_steps, jnp.asarray(sure), jnp.asarray(tolerance))


@eqx.filter_jit
def _solve(
    problem: Problem,
    dissection: Dissection,
    max_steps: int,
    sure: Bool[Array, ""],
    tolerance: Float[Array, ""],
) -> Solution:
    traced: Any = tolerance  # optimistix takes arrays where it says float
    solver = optx.LevenbergMarquardt(
        rtol=traced,
        atol=traced,
        norm=_norm,
        linear_solver=DissectionSolver(problem.keyframes, dissection),
    )
    found = optx.least_squares(
        residuals, solver, problem.start, problem, max_steps=max_steps, throw=False
    )
    unknowns = found.value
    r, jvp = jax.linearize(lambda u: residuals(u, problem), unknowns)
    J, frames = Jacobian.of(jvp, unknowns), problem.keyframes
    blocks = J.blocks(frames, 0.0)

    # each line alone about the poses found, the apparent scale free and then 1
    _, gradient = J.transposed(frames, r)
    weak = jnp.diag(jnp.array([1e-2, 1e-2, 1 / problem.priors.scale_sigma**2]))
    alone = jnp.linalg.inv(blocks.measured + weak)
    free = unknowns.line - jnp.einsum("kij,kj->ki", alone, gradient)
    return Solution(
        unknowns=unknowns,
        cost_before=_cost(residuals(problem.start, problem)),
        cost=_cost(r),
        steps=found.stats["num_steps"],
        converged=found.result == optx.RESULTS.successful,
        marginals=_if(sure, lambda: marginals(eliminate(blocks, dissection))),
        scale_free=free[:, 2],
        scale_sigma=jnp.sqrt(alone[:, 2, 2]),
        on_floor=jax.vmap(on_floor)(free, alone),
    )


def _if(wanted: Bool[Array, ""], make: Callable[[], Any]) -> Any:
    """What `make` makes, or zeros in its place."""
    zeros = lambda: jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(make))
    return jax.lax.cond(wanted, make, zeros)
