"""Step 6 of Fig. 6: the observed segments update the map, as seen from the chosen pose."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from sofjax.segment_map import Observed, SegmentMap, in_view, integrate
from sofjax.slam.choose import Chosen
from sofjax.slam.config import Setup
from sofjax.slam.extract import Extracted, counted_from
from sofjax.slam.reweight import LocalMap


class Updated(eqx.Module):
    """The map after an image, and what each measurement was to it."""

    segment_map: SegmentMap
    known: Bool[Array, "M"]  # it showed a line of the map
    new: Bool[Array, "M"]  # it begins a line ...
    new_slots: Int[Array, "M"]  # ... in this slot, K for none
    overflow: Int[Array, ""]  # new lines that found no free slot


def update_map(
    setup: Setup, segment_map: SegmentMap, extracted: Extracted, local: LocalMap, chosen: Chosen
) -> Updated:
    """The map, updated by segments of known lines and grown by those of new ones.

    A line begins with a segment that is on the floor by eq. (9), that resembles no line of the
    map, and that cannot be the upright edge of something.
    """
    config, sensor = setup.config.segment_map, setup.config.sensor
    T_world_robot, best, measurements = chosen.T_world_robot, chosen.score, extracted.measurements
    known = best.error < sensor.e_max
    unlike = local.nearest > sensor.e_max
    counted = counted_from(setup, extracted, T_world_robot)
    new = (
        extracted.is_sof
        & measurements.valid
        & unlike
        & counted
        & ~known
        & jnp.logical_not(measurements.upright)
    )
    seen = in_view(config, setup.camera, setup.mount, local.lines, T_world_robot)
    observed = Observed(
        measurements, best.jitter, T_world_robot @ setup.mount.T_robot_nadir,
        near=local.near,
        in_view=seen,
        at=jnp.take_along_axis(local.at, best.choice[:, None], 1)[:, 0],
        known=known,
        like=local.at,
        new=new,
    )  # fmt: skip
    segment_map, overflow, new_slots = integrate(config, sensor, segment_map, observed)
    return Updated(segment_map, known, new, new_slots, overflow)
