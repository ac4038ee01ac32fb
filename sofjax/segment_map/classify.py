"""What lies on the floor, and what the final map shows: each by one rule, for filter and smoother.

A line's apparent scale h / (h - z) is 1 on the floor, more above it, less below. It is estimated
from all views of the line, which separates the top of a baseboard and a reflection from the floor.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax.geometry.angles import safe_sqrt
from sofjax.geometry.camera import Mount
from sofjax.segment_map.types import MapConfig, SegmentMap


def is_off_floor(
    config: MapConfig, line: Float[Array, "*lines 3"], covariance: Float[Array, "*lines 3 3"]
) -> Bool[Array, "*lines"]:
    """Whether all views of a line together say that it does not lie on the floor."""
    return scale_is_off_floor(config, line[..., 2], safe_sqrt(covariance[..., 2, 2]))


def scale_is_off_floor(
    config: MapConfig, apparent_scale: Float[Array, "*lines"], sigma: Float[Array, "*lines"]
) -> Bool[Array, "*lines"]:
    """The rule: the apparent scale is outside the range of floors, and significantly not 1."""
    outside = _is_outside(config, apparent_scale)
    return config.classify & outside & (jnp.abs(apparent_scale - 1) > config.scale_gate * sigma)


def _is_outside(config: MapConfig, apparent_scale: Array) -> Array:
    return (apparent_scale > config.scale_above) | (apparent_scale < config.scale_below)


def is_shown(
    config: MapConfig,
    apparent_scale: Float[Array, "*lines"],
    sigma: Float[Array, "*lines"],
    updates: Int[Array, "*lines"],
    expected: Int[Array, "*lines"],
) -> Bool[Array, "*lines"]:
    """The final map's rule: lines seen often enough whose height is known to be the floor's.

    The apparent scale of a line along the robot's path hardly changes: the top of a baseboard that
    was only ever passed by cannot be separated from the floor, and is not shown. What is nearly
    known is shown if it would be the floor's.

    **Arguments:**
    - `sigma`: standard deviation of the apparent scale.
    - `updates`, `expected`: images that have shown a line, and that should have.
    """
    often = updates >= config.min_updates
    fairly = updates.astype(float) >= config.min_share * expected.astype(float)
    inside = ~_is_outside(config, apparent_scale)
    known = (sigma < config.scale_known) & (inside | (sigma <= config.scale_held))
    floor = known & ~scale_is_off_floor(config, apparent_scale, sigma)
    return often & fairly & (~jnp.asarray(config.classify) | floor)


def on_floor(line: Float[Array, "3"], covariance: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The line if it lies on the floor: conditioned on an apparent scale of 1."""
    gain = covariance[:, 2] / covariance[2, 2]
    return (line + gain * (1 - line[2])).at[2].set(1)


def posterior_given_class(
    config: MapConfig, line: Float[Array, "3"], covariance: Float[Array, "3 3"]
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """A line's estimate given its class: of a floor line, conditioned on an apparent scale of 1."""
    gain = covariance[:, 2] / covariance[2, 2]
    certain = covariance - jnp.outer(gain, covariance[2])
    off_floor = is_off_floor(config, line, covariance)
    return (
        jnp.where(off_floor, line, on_floor(line, covariance)),
        jnp.where(off_floor, covariance, certain),
    )


class FinalMap(eqx.Module):
    """What the map says in the end."""

    endpoints_world: Float[Array, "K 2 2"]  # metres
    is_floor: Bool[Array, "K"]  # the segments on the floor; all else is not part of the map
    updates: Int[Array, "K"]  # how often each was seen
    height: Float[Array, "K"]  # metres above the floor, by the views of the line
    height_sigma: Float[Array, "K"]  # metres


def final_map(config: MapConfig, mount: Mount, segment_map: SegmentMap) -> FinalMap:
    """What the filter's map says in the end, by `is_shown`."""
    apparent_scale, sigma = segment_map.line[:, 2], safe_sqrt(segment_map.covariance[:, 2, 2])
    shown = is_shown(config, apparent_scale, sigma, segment_map.updates, segment_map.expected)
    return FinalMap(
        endpoints_world=segment_map.segments_world.endpoints,
        is_floor=segment_map.valid & shown,
        updates=segment_map.updates,
        height=mount.height * (1 - 1 / apparent_scale),
        height_sigma=mount.height * sigma / apparent_scale**2,
    )
