"""Step 5 of Fig. 6: the local map, and how well each particle explains the image by it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sofjax._pytree import half_if_enough
from sofjax.geometry.se2 import SE2
from sofjax.likelihood.density import log_density
from sofjax.likelihood.measurements import Measurements
from sofjax.likelihood.tracking import Candidates, Precomputed, precompute, score
from sofjax.motion import adapt_odometer
from sofjax.particles import Particles
from sofjax.segment_map import SegmentMap, candidate_associations, in_view, nearby
from sofjax.slam.config import Setup
from sofjax.slam.extract import Extracted
from sofjax.slam.predict import Predicted

MARGIN = 1.0  # camera heights by which a map line may be off and still be compared
KNOWN = 0.5  # prior probability that a segment on the floor is one of the map; of the soft form


class LocalMap(eqx.Module):
    """The map lines that the image may show, and which of them each measurement may be."""

    near: Int[Array, "L"]  # slots of the map
    lines: SegmentMap  # [L]
    truncated: Int[Array, ""]  # lines within reach beyond the L
    T_world_nadir: SE2  # the predicted nadir, in whose frame they are compared
    candidates: Candidates  # [M, C]
    at: Int[Array, "M C"]  # which of the L lines they are
    nearest: Float[Array, "M"]  # smallest error e of any line
    precomputed: Precomputed

    def in_its_frame(self, T_world_nadir: SE2) -> SE2:
        """Nadirs [*poses] in the frame of the comparison."""
        return self.T_world_nadir.inverse() @ T_world_nadir


def local_map(
    setup: Setup, segment_map: SegmentMap, measurements: Measurements, T_world_robot: SE2
) -> LocalMap:
    """The lines near a predicted pose, and the candidate associations of the measurements."""
    config, sensor = setup.config.segment_map, setup.config.sensor
    T_world_nadir = T_world_robot @ setup.mount.T_robot_nadir
    ends = jnp.where(measurements.valid[:, None, None], measurements.endpoints_nadir, 0)
    margin = config.join_gap + MARGIN * setup.mount.height
    radius = jnp.sqrt(jnp.sum(ends**2, axis=-1).max()) + margin
    near, truncated = nearby(config, segment_map, T_world_nadir, radius)
    lines = segment_map.take(near)
    candidates, at, nearest = candidate_associations(
        config, sensor, lines, measurements, T_world_nadir
    )
    precomputed = precompute(measurements, candidates)
    return LocalMap(near, lines, truncated, T_world_nadir, candidates, at, nearest, precomputed)


class Weighted(eqx.Module):
    """The particles by prior and image."""

    particles: Particles
    log_likelihood: Float[Array, "N"]
    log_evidence: Float[Array, ""]  # log of the mean likelihood, weighted by the prior
    odometer_inflation: Float[Array, "2"]  # as the particles that are left tell of it


def reweight(setup: Setup, predicted: Predicted, extracted: Extracted, local: LocalMap) -> Weighted:
    """Every particle weighted by the sensor model."""
    particles = predicted.particles
    nadirs = local.in_its_frame(particles.T_world_robot @ setup.mount.T_robot_nadir)
    if setup.config.filter.soft:
        log_likelihood = _soft(setup, predicted, extracted, local, nadirs)
    else:
        log_likelihood = extracted.weight * hard_log_likelihood(
            setup, extracted.measurements, local, nadirs, extracted.used.T
        )
    log_weight = particles.log_weight + log_likelihood
    log_evidence = jax.nn.logsumexp(log_weight)
    weighted = Particles(particles.T_world_robot, particles.bias, log_weight - log_evidence)
    inflation = predicted.odometer_inflation
    if not setup.config.filter.soft:  # whose evidence is of the noise as it is set
        inflation = adapt_odometer(
            setup.config.motion, inflation, jnp.exp(particles.log_weight),
            jnp.exp(weighted.log_weight), predicted.draws, predicted.sensor_is_sound,
        )  # fmt: skip
    return Weighted(weighted, log_likelihood, log_evidence, inflation)


def hard_log_likelihood(
    setup: Setup, measurements: Measurements, local: LocalMap, nadirs: SE2, used: Array
) -> Float[Array, "N"]:
    """log L of N nadirs in the frame of the comparison; `used` [M, N] says what may match."""
    of_rows = lambda rows: score(setup.config.sensor, rows[0], nadirs, rows[1]).log_likelihood
    return half_if_enough(of_rows, (local.precomputed, used), measurements.valid)


def _soft(
    setup: Setup, predicted: Predicted, extracted: Extracted, local: LocalMap, nadirs: SE2
) -> Float[Array, "N"]:
    """log p(segments | pose) of each particle, a density with all its constants.

    What is not used (above the horizon, too far, of an uncertain direction) counts as anywhere in
    the image: how many those are depends on sigmas and mount; a density is of all that was seen.
    """
    config, camera, measurements = setup.config, setup.camera, extracted.measurements
    unused = (extracted.segments_image.valid & ~measurements.valid).sum()
    visible = in_view(
        config.segment_map, camera, setup.mount, local.lines, predicted.T_world_robot
    ).sum()
    elsewhere = -jnp.log(float(camera.width * camera.height))  # its ends anywhere in the image
    lines = jnp.maximum(visible, 1).astype(float)

    def of_one(nadir: SE2, floor: Array) -> Array:
        known = KNOWN * floor.astype(float)  # probabilities, by a gate that is soft or is not
        of_used = log_density(
            config.sensor, measurements, local.candidates, nadir, known, lines, elsewhere
        )
        return of_used + unused.astype(float) * elsewhere

    return jax.vmap(of_one)(nadirs, extracted.used)
