"""Steps 1 to 3 of Fig. 6: the particles move by the odometer's reading and the motion model."""

import equinox as eqx
import jax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sofjax._pytree import in_any_run
from sofjax.extraction.observation import Observation
from sofjax.geometry.se2 import SE2
from sofjax.motion import (
    read_or_unknown,
    read_twist,
    sample_motion,
    sample_slip,
    sample_unknown,
    way_of,
)
from sofjax.particles import Particles, mean_bias, mean_pose
from sofjax.slam.config import Setup
from sofjax.slam.state import SlamState

SLIP_INFLATION = 1.5  # variance inflation up to which the images are witnesses of the wheels


class Predicted(eqx.Module):
    """N particles after the reading and before the image."""

    particles: Particles  # weighted by the prior
    unslipped: Particles  # the same before the slips that some of them try
    log_slip_ratio: Float[Array, "N"]  # log importance weight of those slips
    odometer_inflation: Float[Array, "2"]  # of the variance that was drawn
    draws: Float[Array, "N 2"]  # of the noise in distance and turn, standard deviations
    sensor_is_sound: Bool[Array, ""]  # the last images agreed with the map and the odometer
    T_world_robot: SE2  # their mean
    odometer: SE2  # T_previous_current as read
    unread_sigma: Float[Array, "3"]  # standard deviation of what was not read; metres, radians


def predict(
    setup: Setup,
    state: SlamState,
    observation: Observation,
    key_motion: PRNGKeyArray,
    key_slip: PRNGKeyArray,
) -> Predicted:
    """The particles of the last step, each moved by a draw of the motion model.

    Their mean moves by the reading, corrected by the mean of what was learned of its errors: the
    mean of a cloud that a noise in heading has bent is shorter than any path in it, and where
    nothing is seen the estimate is the odometer's path. The paper's single winner has no mean.
    """
    motion_model, N = setup.config.motion, setup.config.filter.particles
    odometer, unread = read_or_unknown(observation.motion, observation.motion_sigma)
    motion, bias, draws = sample_motion(
        motion_model, state.particles.bias, odometer, key_motion, state.odometer_inflation
    )
    sound = state.variance_inflation < SLIP_INFLATION
    if setup.config.filter.doubting:
        sound = sound & state.consistency.trusted
    testable = sound & observation.segments_image.valid.any()
    slip, log_ratio = sample_slip(motion_model, odometer, testable, key_slip, N)
    start = state.particles.T_world_robot
    start = jax.lax.cond(
        in_any_run((unread > 0).any()),
        lambda: start @ sample_unknown(unread, jax.random.fold_in(key_motion, 1), N),
        lambda: start,
    )
    unslipped = Particles(start @ motion, bias, state.particles.log_weight)
    if setup.config.filter.choice == "resample":
        b = mean_bias(state.particles)
        read = SE2.exp(read_twist(odometer, way_of(odometer), b))
        begun = Particles(start, state.particles.bias, state.particles.log_weight)
        unslipped = unslipped.moved_to(mean_pose(begun) @ read, b)
    prior = state.particles.log_weight + log_ratio
    T_world_robot = unslipped.T_world_robot @ slip
    particles = Particles(T_world_robot, unslipped.bias, prior - jax.nn.logsumexp(prior))
    T_mean = mean_pose(particles)
    return Predicted(
        particles, unslipped, log_ratio, state.odometer_inflation, draws, sound, T_mean, odometer,
        unread,
    )  # fmt: skip
