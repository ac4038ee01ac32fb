"""Which lines lie on the floor, by the height of each line, given a mount."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax._checks import check_fields
from sofjax.calibration.pairs import Estimate, SegmentPairs, U, all_distances


class FloorTestConfig(eqx.Module):
    """When a line counts as a line of the floor."""

    significance: float = 3.0  # standard deviations that its height may be off the floor
    tolerance: float = 0.03  # share of the camera's height that it may be off in any case
    max_rms: float = 3.0  # RMS of its residuals in sigmas, once its height is fitted

    def __check_init__(self) -> None:
        check_fields(self, positive=("significance", "max_rms"), at_least_zero=("tolerance",))


@eqx.filter_jit
def lies_on_floor(
    config: FloorTestConfig,
    estimate: Estimate,
    pairs: SegmentPairs,
    line: Int[Array, "N"],
) -> Bool[Array, "N"]:
    """Whether each pair's line lies on the floor, by all pairs of that line.

    A line above or below the floor moves as if the camera had another height. So each line has
    one unknown, in which the residuals are nearly linear. A line that no height explains does not
    lie in a level plane.

    **Arguments:**
    - `line`: the number of each pair's line, from 0 to N - 1, and -1 for none.
    """
    N = len(line)

    def of_height(log_height: Float[Array, ""]) -> Float[Array, "N 4"]:
        moved = estimate.moved(jnp.zeros(U).at[0].set(log_height))
        r = all_distances(moved, pairs) / pairs.sigma
        return jnp.where(pairs.valid[:, None], r, 0)

    r, J = jax.jvp(of_height, (jnp.zeros(()),), (jnp.ones(()),))
    # the four distances of a pair are two equations
    total = lambda x: jax.ops.segment_sum(jnp.sum(x, axis=1) / 2, line % (N + 1), N + 1)
    count = total(jnp.broadcast_to(pairs.valid[:, None], r.shape).astype(float))
    information = total(J * J) + 1.0  # with a prior as wide as the camera's height
    off = -total(J * r) / information
    left = jnp.maximum(total(r * r) - total(J * r) ** 2 / information, 0)
    rms = jnp.sqrt(left / jnp.maximum(count - 1, 1))
    sigma = jnp.maximum(rms, 1) / jnp.sqrt(information)
    level = jnp.abs(off) < jnp.maximum(config.significance * sigma, config.tolerance)
    return (pairs.valid & level[line % (N + 1)]) & (rms < config.max_rms)[line % (N + 1)]
