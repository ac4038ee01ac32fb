"""The sensor model as a step of the filter evaluates it: poses near the predicted one; III.A.

Each measurement has a few candidate lines, precomputed as they appear from the predicted nadir. A
pose then costs a dozen operations a candidate, and the image's attitude jitter is solved for.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax.geometry.lines import PolarLine, alignment, normal, polar_differences
from sofjax.geometry.se2 import SE2
from sofjax.likelihood.measurements import Measurements
from sofjax.likelihood.sensor_model import SensorModel, squared_error


def adapt_inflation(
    sensor: SensorModel, inflation: Float[Array, ""], misfit: Float[Array, ""]
) -> Float[Array, ""]:
    """The variance inflation after an image: it grows where matched segments disagree too much.

    A mount that is only roughly known, a rolling shutter or blur make all segments inconsistent,
    and a filter that is too sure of its sensor then leaves the odometer. The inflation is at
    least 1 and at most `sensor.noise_max`, from where the sensor can be trusted again.

    **Arguments:**
    - `misfit`: mean of e over the matched segments; 2 if the sigmas are true.
    """
    grown = inflation * jnp.exp(sensor.adaptation * (misfit / 2 - 1))
    return jnp.clip(grown, 1, sensor.noise_max)


def pixels_and_weight(
    sensor: SensorModel, inflation: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """A multiple for the pixels' variance, and a weight for the log-likelihood.

    What pixels do not explain is systematic, such as a mount that is degrees off: it does not
    average out over segments and images, and wider gates would confuse neighbouring lines. So
    beyond `noise_gate` the log-likelihood counts less instead, until the odometer alone decides.
    The soft form takes the variance only: a density has no weight.
    """
    variance = jnp.minimum(inflation, sensor.noise_gate)
    return variance, variance / inflation


class Candidates(eqx.Module):
    """C map lines for each of M measurements, as predicted from the predicted nadir."""

    line: PolarLine  # [M, C]
    apparent_scale: Float[Array, "M C"]  # h / (h - z): 1 on the floor
    precision: Float[Array, "M C 2 2"]  # S⁻¹ of the difference, without jitter
    precision_with_jitter: Float[Array, "M C 2 2"]  # the same with the attitude jitter in S
    valid: Bool[Array, "M C"]


def mahalanobis(
    difference: Float[Array, "*batch 2"], precision: Float[Array, "*#batch 2 2"]
) -> Float[Array, "*batch"]:
    """e = dᵀ W d."""
    return squared_error(symmetric(precision), difference[..., 0], difference[..., 1])


class Precomputed(eqx.Module):
    """All that a score of measurements and candidates needs and that depends on no pose.

    Padding is zero.
    """

    valid: Bool[Array, "M"]  # measurements
    paired: Bool[Array, "M C"]  # valid measurement, valid candidate
    difference: tuple[Float[Array, "M C"], ...]  # of `differences`
    precision: tuple[Float[Array, "M C"], ...]  # W = S⁻¹ by its elements, without jitter
    precision_with_jitter: tuple[Float[Array, "M C"], ...]
    by_jitter: Float[Array, "M 2 2"]  # J = d(rho, theta) / d(pitch, roll)
    normal_equations: Float[Array, "M C 11"]  # Jᵀ W J, and Jᵀ W d as a function of the pose


def precompute(measurements: Measurements, candidates: Candidates) -> Precomputed:
    """Measurements and their candidates, precomputed for `score`."""
    paired = measurements.valid[:, None] & candidates.valid
    difference, loose, W = jax.tree.map(
        lambda a: jnp.where(paired, a, 0),
        (differences(measurements, candidates), symmetric(candidates.precision_with_jitter),
         symmetric(candidates.precision)),
    )  # fmt: skip
    J = jnp.where(measurements.valid[:, None, None], measurements.by_jitter, 0)
    by_axis = [(J[:, 0, k, None], J[:, 1, k, None]) for k in range(2)]  # pitch, roll
    JW = [(W[0] * rho + W[1] * theta, W[1] * rho + W[2] * theta) for rho, theta in by_axis]
    A = [JW[i][0] * by_axis[j][0] + JW[i][1] * by_axis[j][1] for i, j in ((0, 0), (0, 1), (1, 1))]
    d_rho, d_theta, by_x, by_y = difference
    b = [[r * d_rho + t * d_theta, r * by_x, r * by_y, t] for r, t in JW]
    sums = jnp.stack([*A, *b[0], *b[1]], axis=-1)
    return Precomputed(measurements.valid, paired, difference, W, loose, J, sums)


class Score(eqx.Module):
    """Poses against the map; particles are the last axis, over which the loops run."""

    log_likelihood: Float[Array, "*poses"]
    choice: Int[Array, "M *poses"]  # index among the candidates
    error: Float[Array, "M *poses"]  # e of the chosen candidate, its share of the jitter removed
    jitter: Float[
        Array, "2 *poses"
    ]  # most likely attitude jitter (pitch, roll) of the image, radians


def score(
    sensor: SensorModel, pairs: Precomputed, T_predicted_nadir: SE2, used: Bool[Array, "M *#poses"]
) -> Score:
    """log L = -1/2 sum_m min(min_k e[m,k], e_max) of one pose or of many.

    The attitude jitter moves all segments of one image together, which independent errors
    cannot express: the associations are chosen with it as further noise, then its most likely
    value is solved for (two unknowns, prior `tilt_sigma`) and the errors are taken about it.

    Written out in numbers over [M, N] instead of in 2×2 matrices for one pose under `vmap`: XLA
    then makes loops of it that run over the particles, several times faster on a CPU. What the
    jitter's normal equations sum over the chosen candidates is linear in (1, x, y, yaw), and so a
    product of matrices.

    **Arguments:**
    - `T_predicted_nadir`: hypothetical nadirs [*poses] in the predicted nadir's frame, in which the
      candidates are given: near the origin, where the polar form is accurate, and turned by less
      than a right angle.
    - `used`: which measurements may match, of each particle's own SoF extraction. The others cost
      e_max too: a pose must not win by taking nothing for floor.
    """
    poses, C = T_predicted_nadir.yaw.shape, pairs.paired.shape[1]
    x, y, yaw = T_predicted_nadir.xy[..., 0], T_predicted_nadir.xy[..., 1], T_predicted_nadir.yaw
    of_poses = lambda a: a.reshape(*a.shape, *[1] * len(poses))

    def error(
        W: Sequence[Array],
        of: Callable[[Array], Array],
        difference: tuple[Array, ...],
        rho: Any = 0.0,
        theta: Any = 0.0,
    ) -> Array:
        d_rho, d_theta, by_x, by_y = map(of, difference)
        moved = d_rho + (by_x * x + by_y * y), d_theta + yaw
        return squared_error([of(w) for w in W], moved[0] - rho, moved[1] - theta)

    # a scan: it prevents XLA from recomputing all errors for each consumer of the choice
    width = 1 << C.bit_length()

    def nearer(best: Array, candidate: tuple[Any, ...]) -> tuple[Array, None]:
        c, paired, loose, difference = candidate
        key = sortable(error(loose, of_poses, difference), c, width)
        return jnp.where(of_poses(paired) & (key < best), key, best), None

    none = jnp.full((len(used), *poses), sortable(jnp.asarray(sensor.e_max), C, width))
    each = jax.tree.map(
        lambda a: a.T, (pairs.paired, pairs.precision_with_jitter, pairs.difference)
    )
    choice = jax.lax.scan(nearer, none, (jnp.arange(C), *each))[0] & (width - 1)
    choice = jnp.where(used, choice, C).astype(int)

    def of_choice(a: Array) -> Array:
        value = jnp.zeros(())
        for c in range(C):
            value = jnp.where(choice == c, of_poses(a[:, c]), value)
        return value

    chosen = choice[:, None] == of_poses(jnp.arange(C))
    sums = jnp.einsum(
        "mcs,mc...->s...", pairs.normal_equations, chosen.astype(float),
        precision=jax.lax.Precision.HIGHEST,
    )  # fmt: skip
    gradient = [s[0] + s[1] * x + s[2] * y + s[3] * yaw for s in (sums[3:7], sums[7:])]
    jitter, _, prior = solve_jitter(sensor, sums[:3], gradient)

    J = pairs.by_jitter
    rho, theta = (
        of_poses(J[:, i, 0]) * jitter[0] + of_poses(J[:, i, 1]) * jitter[1] for i in range(2)
    )
    tight = error(pairs.precision, of_choice, pairs.difference, rho, theta)
    tight = jnp.where(choice < C, jnp.minimum(tight, sensor.e_max), sensor.e_max)
    total = jnp.sum(jnp.where(of_poses(pairs.valid), tight, 0), axis=0)
    return Score(-0.5 * (total + prior), jnp.where(choice < C, choice, 0), tight, jitter)


def nothing_seen(sensor: SensorModel, pairs: Precomputed) -> Score:
    """What `score` says of any one pose where no measurement is valid."""
    M = pairs.valid.shape[0]
    unlike = jnp.full(M, jnp.asarray(sensor.e_max, float))
    return Score(jnp.zeros(()), jnp.zeros(M, int), unlike, jnp.zeros(2))


def sortable(
    error: Float[Array, "*#shape"], index: Int[Array, "*#shape"] | int, width: int
) -> Int[Array, "*shape"]:
    """Errors and the indices that go with them as one number: a minimum then says both.

    Numbers that are not negative are ordered as their bits are, the last of which give way to the
    index: with those for `width` (a power of two) errors alike to one in 2^23 / width are ordered
    by their index. Modulo `width` it is the index again.
    """
    bits = jax.lax.bitcast_convert_type(jnp.abs(error).astype(jnp.float32), jnp.int32)
    return (bits & -width) | jnp.asarray(index, jnp.int32)


def differences(
    measurements: Measurements, candidates: Candidates
) -> tuple[Float[Array, "M C"], ...]:
    """Observed less expected as the predicted nadir would see it, and what moving the nadir adds.

    **Returns:** the differences in rho and in theta, and what a metre along x and one along y add
    to that in rho; a turn adds itself to that in theta.
    """
    observed = jax.tree.map(lambda a: a[:, None], measurements.line)
    d_rho, d_theta = polar_differences(observed, candidates.line)
    nearing = (alignment(observed, candidates.line) * candidates.apparent_scale)[..., None]
    by_nadir = nearing * normal(candidates.line)
    return d_rho, d_theta, by_nadir[..., 0], by_nadir[..., 1]


def symmetric(W: Float[Array, "*batch 2 2"]) -> tuple[Array, Array, Array]:
    """The elements (0, 0), (0, 1), (1, 1) of symmetric matrices."""
    return W[..., 0, 0], W[..., 0, 1], W[..., 1, 1]


def solve_jitter(
    sensor: SensorModel, information: Sequence[Array] | Array, gradient: Sequence[Array] | Array
) -> tuple[Array, Array, Array]:
    """The most likely jitter of errors d = J jitter + noise: A = Jᵀ W J and b = Jᵀ W d given.

    **Arguments:**
    - `information`: A by its elements (pitch, pitch), (pitch, roll), (roll, roll).

    **Returns:** jitter; det(I + variance A), by which its prior narrows; bᵀ jitter -
    jitterᵀ A jitter.
    """
    variance = sensor.tilt_sigma**2  # (I + variance A)^-1 variance b: right for variance = 0 too
    a, b, c = (
        1 + variance * information[0],
        variance * information[1],
        1 + variance * information[2],
    )
    volume = a * c - b * b
    pitch = variance * (c * gradient[0] - b * gradient[1]) / volume
    roll = variance * (a * gradient[1] - b * gradient[0]) / volume
    prior = gradient[0] * pitch + gradient[1] * roll - squared_error(information, pitch, roll)
    return jnp.stack([pitch, roll]), volume, prior
