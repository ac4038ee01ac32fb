"""Motion model: Gaussian about the odometer's reading, whose systematic errors it learns; III.A."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sofjax._checks import check_fields
from sofjax.extraction.observation import Observation
from sofjax.geometry.angles import safe_sqrt
from sofjax.geometry.se2 import SE2

UNREAD = (0.3, 0.3, 0.3)  # metres and radians, standard deviation of a motion that is not a number
MOST = 2.0  # surplus that one image can tell: faster, and the sensor would be believed first
FADING = 0.9  # power of the inflation in a step without a witness
# names of the systematic errors b, and of the settings that are their prior means
BIAS: tuple[str, ...] = ("distance", "left", "right", "curvature")
MEANS = ("distance_error", "left_error", "right_error", "curvature")


class MotionModel(eqx.Module):
    """How an odometer errs: noise that grows with the way, and systematic errors with priors.

    The systematic errors b = (distance, left turns, right turns, curvature) are relative scales
    and a turn in radians per metre driven; a prior of zero switches one off.
    """

    distance_noise: float = 0.005  # metres per sqrt(metre)
    lateral_noise: float = 0.002  # metres per sqrt(metre)
    heading_noise: float = 0.005  # radians per sqrt(metre)
    turn_noise: float = 0.01  # radians per sqrt(radian)
    distance_scale_sigma: float = 0.01  # prior of the relative error of distances
    turn_scale_sigma: float = 0.05  # prior of the relative errors of left and of right turns
    curvature_sigma: float = 0.005  # radians per metre, prior of the pull to one side
    distance_error: float = 0.0  # share, prior mean of what distances are to be changed by
    left_error: float = 0.0  # share, prior mean of what left turns are to be changed by
    right_error: float = 0.0  # the same of right turns
    curvature: float = 0.0  # radians per metre, prior mean of the turn to the left to be added
    bias_drift: float = 0.02  # share of its prior that a systematic error wanders in sqrt(metre)
    slip_rate: float = 0.003  # slips per metre; none of the above covers a wheel that spins
    slip_distance: float = 0.01  # metres, standard deviation of a slip
    slip_turn: float = 0.05  # radians, standard deviation of a slip
    adaptation: float = 0.1  # share of the surplus by which the variance inflates in a step
    noise_max: float = 1e4  # variance inflation up to which the odometer may be worse than all this

    def __check_init__(self) -> None:
        names = {field.name for field in dataclasses.fields(self)} - {*MEANS, "noise_max"}
        check_fields(self, at_least_zero=tuple(sorted(names)), at_least_one=("noise_max",))


class OdometerBias(eqx.Module):
    """Gaussian belief of the systematic errors b, given a path: one mean a particle.

    Given the path the errors are linear and their posterior is exact (Rao-Blackwell); the
    covariance depends on the odometer's reading alone, so that all particles share it.
    """

    mean: Float[Array, "*batch 4"]
    covariance: Float[Array, "4 4"]


def prior_bias(model: MotionModel) -> OdometerBias:
    return OdometerBias(
        jnp.stack([jnp.asarray(getattr(model, name), float) for name in MEANS]),
        jnp.diag(_prior_sigma(model) ** 2),
    )


def _prior_sigma(model: MotionModel) -> Float[Array, "4"]:
    distance, turn, curvature = (
        jnp.asarray(sigma, float)
        for sigma in (model.distance_scale_sigma, model.turn_scale_sigma, model.curvature_sigma)
    )
    return jnp.stack([distance, turn, turn, curvature])


def way_of(odometer: SE2) -> Float[Array, "*batch 3"]:
    """Metres driven, radians turned left and, negative, right, as read."""
    forward, _, turn = jnp.moveaxis(odometer.log(), -1, 0)
    return jnp.stack([jnp.abs(forward), jnp.maximum(turn, 0), jnp.minimum(turn, 0)], axis=-1)


def read_twist(odometer: SE2, way: Float[Array, "3"], b: Float[Array, "4"]) -> Float[Array, "3"]:
    """What a reading says of the motion if its systematic errors are b: (v_x, v_y, omega)."""
    forward, sideways, turn = odometer.log()
    distance, left, right = way
    turn = turn + left * b[1] + right * b[2] + distance * b[3]
    return jnp.stack([forward * (1 + b[0]), sideways, turn])


def odometer_sigma(
    model: MotionModel,
    way: Float[Array, "3"],
    least: float,
    unknown: Float[Array, "3"] | None = None,
) -> Float[Array, "3"]:
    """Standard deviations of a reading's noise (v_x, v_y, omega) after a way of `way_of`, metres
    and radians; `least` of them is left where nothing was driven.

    **Arguments:**
    - `unknown`: variance of what was not read at all, if there is such.
    """
    distance, left, right = way
    variance = jnp.stack([
        model.distance_noise**2 * distance,
        model.lateral_noise**2 * distance,
        model.heading_noise**2 * distance + model.turn_noise**2 * (left - right),
    ])  # fmt: skip
    if unknown is not None:
        variance = variance + unknown
    return jnp.sqrt(least**2 + variance)


def sample_motion(
    model: MotionModel,
    bias: OdometerBias,
    odometer: SE2,
    key: PRNGKeyArray,
    inflation: Float[Array, "2"] | None = None,
) -> tuple[SE2, OdometerBias, Float[Array, "*batch 2"]]:
    """Draw the motion of one particle or of many, and learn their systematic errors from the draw.

    The motion in distance and turn is z = u + A b + noise, where u is the reading; drawn from
    its marginal, it then updates b as a Kalman filter does.

    **Arguments:**
    - `bias`: beliefs, `mean[*batch, 4]`.
    - `odometer`: T_previous_current as read, metres and radians.
    - `inflation`: by `adapt_odometer`, of the variance of distances and of turns. That of the
      noise and of b alike, so that what a draw tells of b stays what it is.

    **Returns:** T_previous_current drawn [*batch], the beliefs given the draw, and the draws of
    distance and turn in standard deviations.
    """
    forward, sideways, turn = odometer.log()  # along the arc, so that half a turn's error bends it
    distance = jnp.abs(forward)
    left, right = jnp.maximum(turn, 0), jnp.minimum(turn, 0)
    zero = jnp.zeros_like(distance)
    A = jnp.stack(
        [jnp.stack([forward, zero, zero, zero]), jnp.stack([zero, left, right, distance])]
    )
    variance_distance = model.distance_noise**2 * distance
    variance_turn = model.heading_noise**2 * distance + model.turn_noise**2 * (left - right)
    noise = jnp.diag(jnp.stack([variance_distance, variance_turn]))

    wander = jnp.diag((_prior_sigma(model) * model.bias_drift) ** 2 * distance)
    covariance = bias.covariance + wander
    S = A @ covariance @ A.T + noise  # diagonal: distance and turn share no error
    sigma = safe_sqrt(jnp.diag(S))
    inflated = sigma if inflation is None else sigma * jnp.sqrt(inflation)
    # one draw for all: a key for each particle costs more than the rest of this; the particles last
    # and by a product of matrices: it prevents XLA from drawing again for each consumer
    draw = jax.random.normal(key, (3, *bias.mean.shape[:-1]))
    sigmas = jnp.append(inflated, model.lateral_noise * safe_sqrt(distance))
    noise = jnp.tensordot(draw, jnp.diag(sigmas), axes=(0, 0))
    innovation = noise[..., :2]
    moved = jnp.stack([forward, turn]) + bias.mean @ A.T + innovation
    across = sideways + noise[..., 2]

    gain = covariance @ A.T / jnp.where(sigma > 0, sigma, 1) ** 2
    learned = OdometerBias(bias.mean + innovation @ gain.T, covariance - gain @ A @ covariance)
    motion = SE2.exp(jnp.stack([moved[..., 0], across, moved[..., 1]], axis=-1))
    return motion, learned, jnp.moveaxis(draw[:2], 0, -1)


def adapt_odometer(
    model: MotionModel,
    inflation: Float[Array, "2"],
    prior: Float[Array, "N"],
    posterior: Float[Array, "N"],
    draws: Float[Array, "N 2"],
    sound: Bool[Array, ""],
) -> Float[Array, "2"]:
    """The inflation of the odometer's variance (distance, turn) after an image; at least 1.

    It grows where the particles that the image leaves had drawn more of the noise than others: by
    E[z² | image] - E[z²], whose mean is 0 if the noise is as assumed, and also where an image
    tells nothing. It is a step of expectation maximisation, damped.

    **Arguments:**
    - `prior`, `posterior`: weights before and after the image.
    - `draws`: z, of `sample_motion`.
    - `sound`: whether the images agree with the map. If not they are no witness of the odometer,
      and the inflation fades.
    """
    surplus = jnp.minimum((posterior - prior) @ draws**2, MOST)
    grown = jnp.where(sound, jnp.exp(model.adaptation * surplus) * inflation, inflation**FADING)
    return jnp.clip(grown, 1, model.noise_max)


def read_or_unknown(
    odometer: SE2, sigma: Float[Array, "*batch 3"] | None
) -> tuple[SE2, Float[Array, "*batch 3"]]:
    """The reading, and what is not known of it; a reading that is not finite says nothing.

    **Arguments:**
    - `sigma`: what was not known before, as `Observation.motion_sigma`.

    **Returns:** the identity in the place of what is not finite, and standard deviations
    (forward, sideways, turn): metres and radians.
    """
    reading = jnp.concatenate([odometer.xy, odometer.yaw[..., None]], axis=-1)
    finite = jnp.isfinite(reading).all(-1, keepdims=True)
    reading = jnp.where(finite, reading, 0)
    sigma = jnp.where(finite, 0.0 if sigma is None else sigma, jnp.array(UNREAD))
    return SE2(reading[..., :2], reading[..., 2]), sigma


def without_unread_motions(log: Observation) -> Observation:
    """A log whose motions that are not finite are unknown ones; the log itself if there is none.

    On the host, for what sums motions up; `slam.step` asks `read_or_unknown` of each.
    """
    if np.isfinite(log.motion.xy).all() and np.isfinite(log.motion.yaw).all():
        return log
    motion, sigma = read_or_unknown(log.motion, log.motion_sigma)
    return dataclasses.replace(log, motion=motion, motion_sigma=sigma)


def sample_unknown(sigma: Float[Array, "3"], key: PRNGKeyArray, count: int) -> SE2:
    """Draw N motions that an odometer did not tell, to go before those drawn of its reading.

    They are apart from the reading, so that nothing is learned of the odometer's errors from them.

    **Arguments:**
    - `sigma`: standard deviations (forward, sideways, turn), metres and radians.
    """
    return SE2.exp(sigma * jax.random.normal(key, (count, 3)))


ONE_IN = 20  # of so many particles one tries a slip


def sample_slip(
    model: MotionModel,
    odometer: SE2,
    testable: Bool[Array, ""],
    key: PRNGKeyArray,
    count: int,
) -> tuple[SE2, Float[Array, "N"]]:
    """What particles suppose that the wheels reported and the robot did not do.

    Slips are rare and large: many more particles try one than their rate says, and weigh less for
    it, so that without a measurement that tells nothing changes. Those that try are drawn as
    systematic resampling draws: one of every 20, the first of them at random.

    **Arguments:**
    - `odometer`: T_previous_current as read; a robot that stands does not slip.
    - `count`: N particles.

    **Returns:** the motion of each to append to the reading's, mostly none, and the logarithm of
    its importance weight.
    """
    probability = jnp.minimum(model.slip_rate * jnp.abs(odometer.log()[0]), 1 / ONE_IN)
    possible = testable & (probability > 0)
    trying = -(-count // ONE_IN)
    drawn = jax.random.normal(key, (1 + 2 * trying,))
    first = (ONE_IN * ndtr(drawn[0])).astype(int)
    tries = first + ONE_IN * jnp.arange(trying)
    along, turn = drawn[1:].reshape(2, trying)
    along, turn = model.slip_distance * along, model.slip_turn * turn
    each = SE2.exp(jnp.stack([along, jnp.zeros(trying), turn], axis=-1))
    each = jnp.where(possible, jnp.concatenate([each.xy, each.yaw[:, None]], axis=1), 0)
    # scattered to their places: it prevents XLA from recomputing each for all of its twenty
    slip = jnp.zeros((count, 3)).at[tries].set(each, mode="drop")
    probability = jnp.where(possible, probability, 1 / ONE_IN)
    log_weight = jnp.full(count, jnp.log1p(-probability) - jnp.log1p(-1 / ONE_IN))
    log_weight = log_weight.at[tries].set(jnp.log(probability * ONE_IN), mode="drop")
    return SE2(slip[:, :2], slip[:, 2]), jnp.where(possible, log_weight, 0)
