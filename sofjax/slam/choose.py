"""Step 5 of Fig. 6, its end: which particles live on, and which pose the map is updated from."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from sofjax._pytree import in_any_run
from sofjax.geometry.se2 import SE2
from sofjax.likelihood.measurements import unobservable_direction
from sofjax.likelihood.tracking import Score, nothing_seen, score
from sofjax.particles import (
    Particles,
    effective_size,
    mean_bias,
    mean_pose,
    most_likely,
    resample_observable,
    systematic,
)
from sofjax.slam.config import Setup
from sofjax.slam.extract import Extracted, counted_from
from sofjax.slam.predict import Predicted
from sofjax.slam.reweight import LocalMap, Weighted


class Chosen(eqx.Module):
    """The next generation, and the pose of the image."""

    particles: Particles  # the next generation
    weighted: Particles  # before it was drawn
    T_world_robot: SE2  # the estimate
    score: Score  # of a pose among the particles: what each measurement is


def choose(
    setup: Setup,
    predicted: Predicted,
    extracted: Extracted,
    local: LocalMap,
    weighted: Weighted,
    key: PRNGKeyArray,
) -> Chosen:
    """The next generation by systematic resampling, or N times the paper's most likely particle."""
    config, particles = setup.config.filter, weighted.particles
    if config.choice == "winner":
        survivors = particles.take(most_likely(particles.log_weight))
        T_world_robot = mean_pose(survivors)
        best = _score_of(setup, extracted, local, T_world_robot)
        return Chosen(survivors, particles, T_world_robot, best)

    offsets = jax.random.uniform(key, (3,))
    T_world_robot = mean_pose(particles)
    best = _score_of(setup, extracted, local, T_world_robot)
    if not config.soft:  # whose gradient needs particles that are drawn as a whole
        known = best.error < setup.config.sensor.e_max
        along, unobservable = unobservable_direction(extracted.measurements, known)

        def resampled_across() -> Particles:
            drawn = resample_observable(
                offsets[:2], predicted.unslipped, particles.T_world_robot,
                predicted.log_slip_ratio + weighted.log_likelihood,
                predicted.T_world_robot.yaw + along,
            )  # fmt: skip
            return jax.tree.map(lambda a, b: jnp.where(unobservable, a, b), drawn, particles)

        # the likelihood is invariant along this direction, and so `best` stays
        particles = jax.lax.cond(in_any_run(unobservable), resampled_across, lambda: particles)
        T_world_robot = mean_pose(particles)
    few = effective_size(particles.log_weight) < config.effective_share * config.particles

    def resampled() -> Particles:
        drawn = particles.take(systematic(offsets[2], particles.log_weight), config.soft)
        drawn = drawn.moved_to(T_world_robot, mean_bias(particles))  # no chance in the mean
        return jax.tree.map(lambda a, b: jnp.where(few, a, b), drawn, particles)

    survivors = jax.lax.cond(in_any_run(few), resampled, lambda: particles)
    return Chosen(survivors, particles, T_world_robot, best)


def _score_of(setup: Setup, extracted: Extracted, local: LocalMap, T_world_robot: SE2) -> Score:
    """The score of one pose; a `cond` prevents XLA from recomputing it for each consumer."""
    sensor = setup.config.sensor
    T_world_nadir = T_world_robot @ setup.mount.T_robot_nadir
    of_one = lambda: score(
        sensor, local.precomputed, local.T_world_nadir.between(T_world_nadir),
        counted_from(setup, extracted, T_world_robot),
    )  # fmt: skip
    nothing = lambda: nothing_seen(sensor, local.precomputed)
    return jax.lax.cond(in_any_run(extracted.measurements.valid.any()), of_one, nothing)
