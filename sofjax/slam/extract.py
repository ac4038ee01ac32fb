"""Step 4 of Fig. 6: the segments of the image, put on the floor and separated from other lines."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sofjax.extraction.association import gate_probability
from sofjax.extraction.observation import Observation
from sofjax.extraction.sof import SofExtraction, View, extract, view_a_baseline_away
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.likelihood.measurements import Measurements, measure
from sofjax.likelihood.tracking import pixels_and_weight
from sofjax.slam.config import Setup
from sofjax.slam.predict import Predicted
from sofjax.slam.state import Consistency, SlamState


class Extracted(eqx.Module):
    """The image's segments as measurements of lines on the floor."""

    segments_image: Segments
    measurements: Measurements
    view: View  # the earlier image that eq. (9) compares with
    seen: Bool[Array, "M"]  # on the floor's side of the horizon and within range, trusted or not
    is_sof: Bool[Array, "M"]  # on the floor by eq. (9), from the predicted pose
    used: Bool[Array, "N M"] | Float[Array, "N M"]  # what counts for each particle, or how much
    weight: Float[Array, ""]  # of the log-likelihood
    consistency: Consistency  # whether the image shows the odometer's motion


def extract_sof(
    setup: Setup, state: SlamState, observation: Observation, predicted: Predicted
) -> Extracted:
    """The measurements, and SoF (Fig. 5) against a view a baseline away."""
    config, segments_image = setup.config, observation.segments_image
    variance, weight = pixels_and_weight(config.sensor, state.variance_inflation)
    measurements = measure(
        config.sensor, setup.camera, setup.mount, segments_image, config.filter.max_depth, variance
    )
    view = view_a_baseline_away(
        config.association, state.recent, state.reference, predicted.T_world_robot
    )
    is_sof = sof_from(setup, view, segments_image, predicted.T_world_robot).is_floor
    each = predicted.particles.T_world_robot
    if config.filter.gate_each:
        gate = lambda T: _gate(setup, sof_from(setup, view, segments_image, T))
        used = jax.vmap(gate)(each)
    else:
        used = measurements.valid[None]
    used = jnp.broadcast_to(used, (config.filter.particles, used.shape[1]))
    return Extracted(
        segments_image, measurements, view, measurements.valid, is_sof, used, weight,
        state.consistency,
    )  # fmt: skip


def sof_from(
    setup: Setup, view: View, segments_image: Segments, T_world_robot: SE2
) -> SofExtraction:
    """SoF of the image if it was taken from one pose."""
    return extract(
        setup.config.association, setup.camera, setup.mount, view.segments_image, segments_image,
        view.T_world_robot.between(T_world_robot), setup.config.filter.max_depth,
    )  # fmt: skip


def counted_from(setup: Setup, extracted: Extracted, T_world_robot: SE2) -> Bool[Array, "M"]:
    """Which measurements may match if the image was taken from one pose."""
    if not setup.config.filter.gate_each:
        return extracted.measurements.valid
    return sof_from(setup, extracted.view, extracted.segments_image, T_world_robot).is_floor


def _gate(setup: Setup, found: SofExtraction) -> Array:
    """Which segments are on the floor, or if soft, how probably."""
    if not setup.config.filter.soft:
        return found.is_floor
    probability = gate_probability(setup.config.association, found.matches.error)
    return jnp.where(found.segments_robot.valid, probability, 0)
