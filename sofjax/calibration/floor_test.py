"""Which of the lines lie on the floor: each line's own height, given a mount."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from sofjax.calibration.pairs import Estimate, Pairs, U, all_distances
from sofjax.geometry.camera import Camera


class FloorTestConfig(eqx.Module):
    """When a line counts as floor."""

    significance: float = 3.0  # standard deviations that its height may be off the floor
    tolerance: float = 0.03  # of the camera's height, that it may be off in any case
    misfit: float = 3.0  # root mean square of its residuals in sigmas, the height fitted


@eqx.filter_jit
def on_floor(
    rules: FloorTestConfig, camera: Camera, estimate: Estimate, pairs: Pairs, line: Int[Array, "N"]
) -> Bool[Array, "N"]:
    """Whether each pair's line lies on the floor, by all pairs of that line.

    A line at another height moves as if the camera had another height: one number for a line, of
    which the residuals are nearly linear. What no height explains is no line of a level plane.

    **Arguments:**
    - `line`: the number of each pair's line, from 0 to N - 1, and -1 for none.
    """
    N = len(line)

    def of_height(log_height):
        moved = estimate.moved(jnp.zeros(U).at[0].set(log_height))
        r = all_distances(camera, moved, pairs) / pairs.sigma
        return jnp.where(pairs.valid[:, None], r, 0)

    r, J = jax.jvp(of_height, (jnp.zeros(()),), (jnp.ones(()),))
    # all four distances of a pair say two things
    total = lambda x: jax.ops.segment_sum(jnp.sum(x, axis=1) / 2, line % (N + 1), N + 1)
    count = total(jnp.broadcast_to(pairs.valid[:, None], r.shape).astype(float))
    information = total(J * J) + 1.0  # as if known to one height of the camera: it never is worse
    off = -total(J * r) / information
    left = jnp.maximum(total(r * r) - total(J * r) ** 2 / information, 0)
    misfit = jnp.sqrt(left / jnp.maximum(count - 1, 1))
    sigma = jnp.maximum(misfit, 1) / jnp.sqrt(information)
    level = jnp.abs(off) < jnp.maximum(rules.significance * sigma, rules.tolerance)
    return (pairs.valid & level[line % (N + 1)]) & (misfit < rules.misfit)[line % (N + 1)]
