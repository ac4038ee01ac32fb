"""How well a hypothetical pose explains the measurements of an image; III.A."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax.geometry.lines import PolarLine, alignment, normal, polar_differences
from sofjax.geometry.matrices import determinant_2x2
from sofjax.geometry.se2 import SE2
from sofjax.likelihood.measurements import Measurements, SensorModel


def adapt_noise(
    sensor: SensorModel, noise: Float[Array, ""], misfit: Float[Array, ""]
) -> Float[Array, ""]:
    """Believe the pixels less where matched segments disagree more than their sigmas allow.

    A mount that is only roughly known, a rolling shutter or blur make all of them inconsistent,
    and a filter that is too sure of its sensor then leaves the odometer. Matched errors e have
    the mean 2; the noise never falls below the sensor model's, nor grows so far that the sensor
    could not be trusted again.
    """
    grown = noise * jnp.exp(sensor.adaptation * (misfit / 2 - 1))
    return jnp.clip(grown, 1, sensor.noise_max)


def pixels_and_weight(
    sensor: SensorModel, noise: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """What the noise makes of the pixels' variance, as a multiple, and of the likelihood's weight.

    What pixels do not explain is systematic, as the tilt of a mount that is degrees off: it does
    not average out over segments and images, and wider gates would only take neighbours for one
    another. So beyond `noise_gate` the logarithm of the likelihood counts less instead, until the
    odometer alone decides. The soft form takes the variance only: a density has no weight.
    """
    variance = jnp.minimum(noise, sensor.noise_gate)
    return variance, variance / noise


class Candidates(eqx.Module):
    """C map lines for each of M measurements, as they should appear from the predicted nadir."""

    line: PolarLine  # [M, C]
    apparent_scale: Float[Array, "M C"]  # magnification; 1 for what lies on the floor
    precision: Float[Array, "M C 2 2"]  # inverse covariance of the difference, tilt apart
    precision_tilt: Float[Array, "M C 2 2"]  # the same with the jitter of the tilt in it
    valid: Bool[Array, "M C"]


def mahalanobis(
    difference: Float[Array, "*batch 2"], precision: Float[Array, "*#batch 2 2"]
) -> Float[Array, "*batch"]:
    """e = dᵀ W d."""
    return _quadratic(_symmetric(precision), difference[..., 0], difference[..., 1])


class Pairs(eqx.Module):
    """Each measurement with each of its candidates, as far as no pose is needed to compare them.

    Numbers of what is padding are zero. Worked out once, whatever is compared with it.
    """

    valid: Bool[Array, "M"]  # measurements
    there: Bool[Array, "M C"]
    difference: tuple[Float[Array, "M C"], ...]  # of `_differences`
    precision: tuple[Float[Array, "M C"], ...]  # W by its elements, tilt apart
    precision_tilt: tuple[Float[Array, "M C"], ...]
    tilt: Float[Array, "M 2 2"]  # J = d(rho, theta) / d(pitch, roll)
    normal_equations: Float[Array, "M C 11"]  # Jᵀ W J, and Jᵀ W d as a function of the pose


def pair(measurements: Measurements, candidates: Candidates) -> Pairs:
    """Measurements and their candidates, made ready for `compare`."""
    there = measurements.valid[:, None] & candidates.valid
    difference, loose, W = jax.tree.map(
        lambda a: jnp.where(there, a, 0),
        (_differences(measurements, candidates), _symmetric(candidates.precision_tilt),
         _symmetric(candidates.precision)),
    )  # fmt: skip
    J = jnp.where(measurements.valid[:, None, None], measurements.tilt, 0)
    by_tilt = [(J[:, 0, k, None], J[:, 1, k, None]) for k in range(2)]  # pitch, roll
    JW = [(W[0] * rho + W[1] * theta, W[1] * rho + W[2] * theta) for rho, theta in by_tilt]
    A = [JW[i][0] * by_tilt[j][0] + JW[i][1] * by_tilt[j][1] for i, j in ((0, 0), (0, 1), (1, 1))]
    d_rho, d_theta, by_x, by_y = difference
    b = [[r * d_rho + t * d_theta, r * by_x, r * by_y, t] for r, t in JW]
    sums = jnp.stack([*A, *b[0], *b[1]], axis=-1)
    return Pairs(measurements.valid, there, difference, W, loose, J, sums)


class Comparison(eqx.Module):
    """Poses against the map; particles are the last axis, over which the loops run."""

    log_likelihood: Float[Array, "*poses"]
    choice: Int[Array, "M *poses"]  # index among the candidates
    error: Float[Array, "M *poses"]  # e of the chosen candidate, its share of the tilt removed
    tilt: Float[Array, "2 *poses"]  # most likely jitter (pitch, roll) of the moment, radians


def compare(
    sensor: SensorModel, pairs: Pairs, T_predicted_nadir: SE2, used: Bool[Array, "M *#poses"]
) -> Comparison:
    """log L = -1/2 sum_m min(min_k e[m,k], e_max) of one pose or of many.

    The jitter of the tilt moves all segments of one image together, which independent errors
    cannot express: the associations are chosen with it as further noise, then its most likely
    value is solved for (two unknowns, prior `tilt_sigma`) and the errors are taken about it.

    Written out in numbers over [M, N] instead of in 2×2 matrices for one pose under `vmap`: XLA
    then makes loops of it that run over the particles, several times faster on a CPU. What the
    normal equations of the tilt sum over the chosen candidates is linear in (1, x, y, yaw), and so
    a product of matrices.

    **Arguments:**
    - `T_predicted_nadir`: hypothetical nadirs [*poses] in the predicted nadir's frame, in which the
      candidates are given: near the origin, where the polar form is accurate, and turned by less
      than a right angle.
    - `used`: which measurements may match, of each particle's own SoF extraction. The others cost
      e_max too: a pose must not win by taking nothing for floor.
    """
    poses, C = T_predicted_nadir.yaw.shape, pairs.there.shape[1]
    x, y, yaw = T_predicted_nadir.xy[..., 0], T_predicted_nadir.xy[..., 1], T_predicted_nadir.yaw
    of_poses = lambda a: a.reshape(*a.shape, *[1] * len(poses))

    def error(W, of, difference, rho=0.0, theta=0.0):
        d_rho, d_theta, by_x, by_y = map(of, difference)
        moved = d_rho + (by_x * x + by_y * y), d_theta + yaw
        return _quadratic([of(w) for w in W], moved[0] - rho, moved[1] - theta)

    # a scan, as whoever asks for the choice would otherwise work all errors out anew
    width = 1 << C.bit_length()

    def nearer(best, candidate):
        c, there, loose, difference = candidate
        key = sortable(error(loose, of_poses, difference), c, width)
        return jnp.where(of_poses(there) & (key < best), key, best), None

    none = jnp.full((len(used), *poses), sortable(jnp.asarray(sensor.e_max), C, width))
    each = jax.tree.map(lambda a: a.T, (pairs.there, pairs.precision_tilt, pairs.difference))
    choice = jax.lax.scan(nearer, none, (jnp.arange(C), *each))[0] & (width - 1)
    choice = jnp.where(used, choice, C).astype(int)

    def of_choice(a):
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
    tilt, _, prior = _solve_tilt(sensor, sums[:3], gradient)

    J = pairs.tilt
    rho, theta = (of_poses(J[:, i, 0]) * tilt[0] + of_poses(J[:, i, 1]) * tilt[1] for i in range(2))
    tight = error(pairs.precision, of_choice, pairs.difference, rho, theta)
    tight = jnp.where(choice < C, jnp.minimum(tight, sensor.e_max), sensor.e_max)
    total = jnp.sum(jnp.where(of_poses(pairs.valid), tight, 0), axis=0)
    return Comparison(-0.5 * (total + prior), jnp.where(choice < C, choice, 0), tight, tilt)


def nothing_seen(sensor: SensorModel, pairs: Pairs) -> Comparison:
    """What `compare` says of any one pose where no measurement is valid."""
    M = pairs.valid.shape[0]
    unlike = jnp.full(M, jnp.asarray(sensor.e_max, float))
    return Comparison(jnp.zeros(()), jnp.zeros(M, int), unlike, jnp.zeros(2))


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


def log_density(
    sensor: SensorModel,
    measurements: Measurements,
    candidates: Candidates,
    T_predicted_nadir: SE2,
    known: Float[Array, "M"],
    lines: Float[Array, ""],
    log_elsewhere: Float[Array, ""],
) -> Float[Array, ""]:
    """log p(segments | pose), the soft form of `compare`, with its constants; to differentiate.

    Each measurement is one of the map's lines with the probability `known`, any of them alike, and
    anywhere in the image otherwise; the candidates stand for all lines, as the others are too far
    away to matter. The density is that of the end points across the line, per pixel², so that it
    falls when a sigma is too large or too small and compares different mounts. The jitter of the
    tilt is integrated out, about the value that the candidates, each by its share, make most
    likely: exactly, if the shares are certain.

    **Arguments:**
    - `known`: probabilities of the measurements, less than 1.
    - `lines`: how many of the map's lines are in view.
    - `log_elsewhere`: log density of a segment that is no line of the map, per pixel².
    """
    there = measurements.valid[:, None] & candidates.valid
    d_rho, d_theta, by_x, by_y = _differences(measurements, candidates)
    x, y = T_predicted_nadir.xy
    moved = jnp.stack([d_rho + (by_x * x + by_y * y), d_theta + T_predicted_nadir.yaw], axis=-1)
    difference = jnp.where(there[..., None], moved, 0)
    log_area = jnp.where(measurements.valid, measurements.log_area, 0)[:, None]
    known = known[:, None]
    weights = jnp.concatenate([jnp.where(there, known / lines, 0), 1 - known], axis=1)
    elsewhere = jnp.broadcast_to(log_elsewhere, known.shape)

    def log_mixture(d, W):
        log_normal = 0.5 * (jnp.log(determinant_2x2(W)) - mahalanobis(d, W)) - jnp.log(2 * jnp.pi)
        each = jnp.concatenate([log_normal + log_area, elsewhere], axis=1)
        return each, jax.nn.logsumexp(each, axis=1, b=weights)

    W, W_tilt = (
        jnp.where(there[..., None, None], a, jnp.eye(2))
        for a in (candidates.precision, candidates.precision_tilt)
    )
    each, total = log_mixture(difference, W_tilt)
    share = weights * jnp.exp(jnp.where(weights > 0, each - total[:, None], -jnp.inf))
    J = jnp.broadcast_to(measurements.tilt[:, None], W.shape)
    JW = jnp.swapaxes(J, -1, -2) @ (share[:, :-1, None, None] * W)
    information = jnp.stack(_symmetric(jnp.sum(JW @ J, axis=(0, 1))))
    gradient = jnp.sum((JW @ difference[..., None])[..., 0], axis=(0, 1))
    tilt, volume, prior = _solve_tilt(sensor, information, gradient)
    _, total = log_mixture(difference - J @ tilt, W)
    return jnp.sum(jnp.where(measurements.valid, total, 0)) - 0.5 * (prior + jnp.log(volume))


def _differences(
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


def _symmetric(W: Float[Array, "*batch 2 2"]) -> tuple[Array, Array, Array]:
    return W[..., 0, 0], W[..., 0, 1], W[..., 1, 1]


def _quadratic(W, d_rho, d_theta):
    """e = dᵀ W d by W's elements: for a diagonal W the definition, (d_rho/sigma_rho)² + ..."""
    return W[0] * d_rho**2 + 2 * W[1] * d_rho * d_theta + W[2] * d_theta**2


def _solve_tilt(sensor, information, gradient):
    """The most likely jitter of errors d = J tilt + noise: A = Jᵀ W J and b = Jᵀ W d given.

    **Arguments:**
    - `information`: A by its elements (pitch, pitch), (pitch, roll), (roll, roll).

    **Returns:** tilt; det(I + variance A), by which it narrows its prior; bᵀ tilt - tiltᵀ A tilt.
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
    prior = gradient[0] * pitch + gradient[1] * roll - _quadratic(information, pitch, roll)
    return jnp.stack([pitch, roll]), volume, prior
