"""Step 7 of Fig. 6: the state that the next round starts from, and what this one reports."""

import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from sofjax.extraction.sof import View, keep_views
from sofjax.likelihood.tracking import adapt_inflation
from sofjax.particles import effective_size, mean_bias, pose_covariance
from sofjax.slam.choose import Chosen
from sofjax.slam.config import Setup
from sofjax.slam.extract import Extracted
from sofjax.slam.map_update import Updated
from sofjax.slam.reweight import LocalMap, Weighted
from sofjax.slam.state import SlamState, StepInfo

LOST_AFTER = 10  # images without one known segment
ACROSS = 0.5  # sine of the angle to the heading from which a line is transverse


def advance(
    setup: Setup,
    state: SlamState,
    extracted: Extracted,
    local: LocalMap,
    weighted: Weighted,
    chosen: Chosen,
    updated: Updated,
    key: PRNGKeyArray,
) -> tuple[SlamState, StepInfo]:
    """The next state, and the report of this image."""
    config, measurements = setup.config, extracted.measurements
    known, error = updated.known, chosen.score.error
    recent, reference = keep_views(
        config.association, state.recent, state.reference,
        View(extracted.segments_image, chosen.T_world_robot, extracted.consistency.T_odometer),
    )  # fmt: skip
    misfit = jnp.where(known, error, 0).sum() / jnp.maximum(known.sum(), 1).astype(float)
    inflation = jnp.where(
        known.any(),
        adapt_inflation(config.sensor, state.variance_inflation, misfit),
        state.variance_inflation,
    )
    unmatched = jnp.where(known.any(), 0, state.unmatched + 1)
    detected = extracted.segments_image.valid
    on_floor = measurements.valid & (known | updated.new)
    info = StepInfo(
        T_world_robot=chosen.T_world_robot,
        covariance=pose_covariance(chosen.weighted),
        bias=mean_bias(chosen.weighted),
        effective_size=effective_size(weighted.particles.log_weight),
        log_evidence=weighted.log_evidence,
        jitter=chosen.score.jitter,
        misfit=misfit,
        sensor_inflation=inflation,
        odometer_inflation=weighted.odometer_inflation,
        trusted=extracted.consistency.trusted,
        detected=detected.sum(),
        below_horizon=extracted.seen.sum(),
        associated=extracted.is_sof.sum(),
        reobserved=(extracted.is_sof & known).sum(),
        matched=known.sum(),
        across=(known & (jnp.abs(jnp.sin(measurements.line.theta)) > ACROSS)).sum(),
        initialised=updated.new.sum() - updated.overflow,
        map_overflow=updated.overflow,
        map_truncated=local.truncated,
        lost=unmatched >= LOST_AFTER,
        segment_class=detected.astype(int) + extracted.seen.astype(int) + on_floor.astype(int),
    )
    after = SlamState(
        chosen.particles, updated.segment_map, recent, reference, inflation,
        weighted.odometer_inflation, extracted.consistency, unmatched, key, state.window,
    )  # fmt: skip
    return after, info
