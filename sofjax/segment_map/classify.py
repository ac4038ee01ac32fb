"""What the map says in the end: the segments that lie on the floor."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax.geometry.angles import safe_sqrt
from sofjax.geometry.camera import Mount
from sofjax.segment_map.types import MapConfig, SegmentMap, is_off_floor


class FinalMap(eqx.Module):
    """What the map says in the end."""

    endpoints_world: Float[Array, "K 2 2"]  # metres
    is_floor: Bool[Array, "K"]  # the segments on the floor; all else is not part of the map
    updates: Int[Array, "K"]  # how often each was seen
    height: Float[Array, "K"]  # metres above the floor, by the views of the line
    height_sigma: Float[Array, "K"]  # metres


def final_map(rules: MapConfig, mount: Mount, segment_map: SegmentMap) -> FinalMap:
    """The segments seen often enough that do not stand above the floor."""
    off_floor = is_off_floor(rules, segment_map.line, segment_map.covariance)
    often = segment_map.updates >= rules.min_updates
    apparent_scale, sigma = segment_map.line[:, 2], safe_sqrt(segment_map.covariance[:, 2, 2])
    known = ~jnp.asarray(rules.classify) | (sigma < rules.scale_known)
    updates, expected = segment_map.updates.astype(float), segment_map.expected.astype(float)
    shown = updates >= rules.min_share * expected
    return FinalMap(
        endpoints_world=segment_map.segments_world.endpoints,
        is_floor=segment_map.valid & often & shown & known & ~off_floor,
        updates=segment_map.updates,
        height=mount.height * (1 - 1 / apparent_scale),
        height_sigma=mount.height * sigma / apparent_scale**2,
    )
