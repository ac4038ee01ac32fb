"""The least-squares solution and how sure it is."""

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from sofjax.smoothing.arrow import ArrowSolver, assemble
from sofjax.smoothing.problem import LINE, Problem, Unknowns, residuals

TOLERANCE = 1e-4  # metres, radians and, relative, of the cost: of the last step


class Solution(eqx.Module):
    """The estimate and how sure it is."""

    unknowns: Unknowns
    cost_before: Float[Array, ""]  # half the sum of squared residuals
    cost: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]
    pose_covariance: Float[Array, "n 5 5"]
    line_covariance: Float[Array, "K 3 3"]
    joint: Float[Array, "K 3 K 3"]  # covariance of all lines with each other
    shared_covariance: Float[Array, "8 8"]
    kappa_free: Float[Array, "K"]  # each line's kappa if it alone were free, poses held ...
    kappa_sigma: Float[Array, "K"]  # ... and its standard deviation


def _cost(unknowns, problem):
    return 0.5 * sum(jnp.sum(r**2) for r in jax.tree.leaves(residuals(unknowns, problem)))


@eqx.filter_jit
def solve(problem: Problem, max_steps: int = 60) -> Solution:
    """Levenberg-Marquardt from `problem.start`. Expects float64; see `jax.enable_x64`.

    **Returns:** the estimate with marginal covariances. `converged` is false where `max_steps` did
    not suffice; the estimate is then the best so far.
    """
    solver = optx.LevenbergMarquardt(
        rtol=TOLERANCE, atol=TOLERANCE, linear_solver=ArrowSolver(problem.keyframes)
    )
    found = optx.least_squares(
        residuals, solver, problem.start, problem, max_steps=max_steps, throw=False
    )
    unknowns = found.value
    _, jvp = jax.linearize(lambda u: residuals(u, problem), unknowns)
    arrow = assemble(jvp, problem.keyframes, unknowns, 0.0)
    Z, S = arrow.reduce()
    rest = jnp.linalg.inv(S)
    K = unknowns.line.shape[0]
    pose = arrow.diagonal_of_inverse() + jnp.einsum("nib,bc,njc->nij", Z, rest, Z)
    lines = rest[: K * LINE, : K * LINE].reshape(K, LINE, K, LINE)
    k = jnp.arange(K)

    # each line alone, kappa free, about the poses found
    _, vjp = jax.vjp(
        lambda line: residuals(eqx.tree_at(lambda u: u.line, unknowns, line), problem).pixels,
        unknowns.line,
    )
    gradient = vjp(residuals(unknowns, problem).pixels)[0]
    weak = jnp.diag(jnp.array([1e-2, 1e-2, 1 / problem.priors.kappa_sigma**2]))
    alone = jnp.linalg.inv(arrow.line + weak)
    free = unknowns.line[:, 2] - jnp.einsum("ki,ki->k", alone[:, 2], gradient)
    return Solution(
        unknowns=unknowns,
        cost_before=_cost(problem.start, problem),
        cost=_cost(unknowns, problem),
        steps=found.stats["num_steps"],
        converged=found.result == optx.RESULTS.successful,
        pose_covariance=pose,
        line_covariance=lines[k, :, k, :],
        joint=lines,
        shared_covariance=rest[K * LINE :, K * LINE :],
        kappa_free=free,
        kappa_sigma=jnp.sqrt(alone[:, 2, 2]),
    )
