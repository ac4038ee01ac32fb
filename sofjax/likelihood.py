"""Sensor model: how well a hypothetical pose explains the observed segments; III.A.

Everything here happens in the frame of the camera's foot, the floor point under the optical
centre with the axes of the robot: there the apparent line of anything parallel to the floor keeps
its direction, and its distance rho is the true one times the magnification kappa = h / (h - z).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax.geometry.angles import safe_sqrt
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.floor import floor_homography, may_be_upright, segment_to_floor
from sofjax.geometry.lines import (
    PolarLine,
    alignment,
    normal,
    polar_differences,
    polar_through,
)
from sofjax.geometry.matrices import determinant_2x2
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments


class SensorModel(eqx.Module):
    """Gaussian noise of a segment in (rho, theta), and the cost of one that fits nothing."""

    propagate: bool = eqx.field(static=True, default=True)  # or the paper's constant sigmas
    pixel_sigma: float = 0.5  # pixels, of an end point across its segment
    tilt_sigma: float = 0.001  # radians, wobble of pitch and of roll from image to image
    rho_sigma: float = 0.02  # metres; the constant sigmas, and with `propagate` ...
    theta_sigma: float = 0.02  # radians; ... unused
    upright: float = 1.0  # pixels that the ends of an upright edge may be off a line to the foot
    theta_limit: float = 0.3  # radians; a segment whose direction is known less well is not used
    adaptation: float = 0.3  # share of the surplus misfit by which the noise grows in a step
    noise_gate: float = 4.0  # multiple of the variance up to which it widens what may match; ...
    noise_max: float = 1e4  # ... up to here it only lessens the weight of the sightings
    e_max: float = 9.0  # cost of an observed segment that matches nothing


class Sightings(eqx.Module):
    """M observed segments on the floor, with their errors."""

    endpoints_foot: Float[Array, "*batch 2 2"]  # metres
    valid: Bool[Array, "*batch"]
    line: PolarLine  # about the foot
    covariance: Float[Array, "*batch 2 2"]  # of (rho, theta), from noise of the end points alone
    tilt: Float[Array, "*batch 2 2"]  # d(rho, theta) / d(pitch, roll) of the camera's wobble
    log_area: Float[Array, "*batch"] | float = 0.0  # log of (metres · radians) that a pixel² makes
    upright: Bool[Array, "*batch"] | bool = False  # it may be: no line of the map begins with it

    def under_tilt(self, tilt: Float[Array, "2"]) -> PolarLine:
        """The lines, corrected for a wobble (pitch, roll) of the mount."""
        shift = self.tilt @ tilt
        return PolarLine(self.line.rho - shift[..., 0], self.line.theta - shift[..., 1])


def sight(
    sensor: SensorModel,
    camera: Camera,
    mount: Mount,
    segments_image: Segments,
    max_depth: Float[Array, ""] | float,
    noise: Float[Array, ""] | float = 1.0,
) -> Sightings:
    """Put an image's segments on the floor together with their own covariances.

    The covariance of (rho, theta) is carried from the pixels by the Jacobian of the inverse
    projection that is used, eq. (13). Differs from the paper: it has one constant sigma, which
    `sensor.propagate = False` brings back.

    **Arguments:**
    - `segments_image`: M segments, pixels of the undistorted image.
    - `max_depth`: metres; what is farther is clipped away.
    - `noise`: multiple of the variance of the pixels.
    """
    foot = mount.T_robot_foot.xy

    def on_floor(endpoints_image, tilt):
        wobbling = eqx.tree_at(
            lambda m: (m.pitch, m.roll), mount, (mount.pitch + tilt[0], mount.roll + tilt[1])
        )
        H_F = floor_homography(camera, wobbling, SE2.identity())
        endpoints, some = segment_to_floor(H_F, endpoints_image, jnp.asarray(max_depth))
        line = polar_through(endpoints - foot)
        return jnp.stack([line.rho, line.theta]), (endpoints - foot, line, some)

    def one(endpoints_image):
        (by_pixel, by_tilt), (endpoints, line, some) = jax.jacfwd(
            on_floor, argnums=(0, 1), has_aux=True
        )(endpoints_image, jnp.zeros(2))
        by_pixel = by_pixel.reshape(2, 4)
        propagated = noise * sensor.pixel_sigma**2 * by_pixel @ by_pixel.T
        area2 = determinant_2x2(by_pixel @ by_pixel.T)
        log_area = 0.5 * jnp.log(jnp.where(area2 > 0, area2, 1))
        return endpoints, line, some, propagated, by_tilt, log_area

    endpoints, line, some, covariance, tilt, log_area = jax.vmap(one)(segments_image.endpoints)
    if not sensor.propagate:
        constant = jnp.array([sensor.rho_sigma, sensor.theta_sigma]) ** 2
        covariance = jnp.broadcast_to(jnp.diag(constant), covariance.shape)
        tilt = jnp.zeros_like(tilt)
    has_length = (segments_image.endpoints[:, 0] != segments_image.endpoints[:, 1]).any(axis=-1)
    some = some & has_length & (covariance[:, 1, 1] < sensor.theta_limit**2)
    foot_image = floor_homography(camera, mount, SE2.identity()) @ jnp.append(foot, 1)
    upright = jax.vmap(may_be_upright, in_axes=(None, 0, None))(
        foot_image, segments_image.endpoints, sensor.upright
    )
    # what is reported at the nominal tilt moves against the correction
    some = some & segments_image.valid
    return Sightings(endpoints, some, line, covariance, -tilt, log_area, upright)


PARALLEL = 0.05  # radians


def free_direction(
    sightings: Sightings, known: Bool[Array, "M"]
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """The direction along which the known lines run, if they all do: no pose along it is told from
    another.

    **Returns:** radians about the foot, and whether all run along it as far as can be seen.
    """
    theta, variance = (
        jnp.where(known, a, 0) for a in (sightings.line.theta, sightings.covariance[:, 1, 1])
    )
    weight = jnp.where(known, 1 / (variance + PARALLEL**2), 0)
    free = jnp.arctan2(weight @ jnp.sin(2 * theta), weight @ jnp.cos(2 * theta)) / 2
    along = jnp.abs(jnp.sin(theta - free)) < PARALLEL + 3 * safe_sqrt(variance)
    return free, (along | ~known).all() & known.any()


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
    """C map lines for each of M sightings, as they should appear from the predicted foot."""

    line: PolarLine  # [M, C]
    kappa: Float[Array, "M C"]  # magnification; 1 for what lies on the floor
    precision: Float[Array, "M C 2 2"]  # inverse covariance of the difference, tilt apart
    precision_tilt: Float[Array, "M C 2 2"]  # the same with the wobble of the tilt in it
    valid: Bool[Array, "M C"]


def mahalanobis(
    difference: Float[Array, "*batch 2"], precision: Float[Array, "*#batch 2 2"]
) -> Float[Array, "*batch"]:
    """e = dᵀ W d."""
    return _quadratic(_symmetric(precision), difference[..., 0], difference[..., 1])


class Comparison(eqx.Module):
    """Poses against the map; particles are the last axis, over which the loops run."""

    log_likelihood: Float[Array, "*poses"]
    choice: Int[Array, "M *poses"]  # index among the candidates
    error: Float[Array, "M *poses"]  # e of the chosen candidate, its share of the tilt removed
    tilt: Float[Array, "2 *poses"]  # most likely wobble (pitch, roll) of the moment, radians


def compare(
    sensor: SensorModel,
    sightings: Sightings,
    candidates: Candidates,
    T_predicted_foot: SE2,
    used: Bool[Array, "M *#poses"],
) -> Comparison:
    """log L = -1/2 sum_m min(min_k e[m,k], e_max) of one pose or of many.

    The wobble of the tilt moves all segments of one image together, which independent errors
    cannot express: the associations are chosen with it as further noise, then its most likely
    value is solved for (two unknowns, prior `tilt_sigma`) and the errors are taken about it.

    Written out in numbers over [M, N] instead of in 2×2 matrices for one pose under `vmap`: XLA
    then makes loops of it that run over the particles, several times faster on a CPU. What the
    normal equations of the tilt sum over the chosen candidates is linear in (1, x, y, yaw), and so
    a product of matrices.

    **Arguments:**
    - `T_predicted_foot`: hypothetical feet [*poses] in the predicted foot's frame, in which the
      candidates are given: near the origin, where the polar form is accurate, and turned by less
      than a right angle.
    - `used`: which sightings may match, of each particle's own SoF extraction. The others cost
      e_max too: a pose must not win by taking nothing for floor.
    """
    poses, C = T_predicted_foot.yaw.shape, candidates.kappa.shape[1]
    x, y, yaw = T_predicted_foot.xy[..., 0], T_predicted_foot.xy[..., 1], T_predicted_foot.yaw
    of_poses = lambda a: a.reshape(*a.shape, *[1] * len(poses))
    there = sightings.valid[:, None] & candidates.valid
    d_rho, d_theta, by_x, by_y, loose, W = jax.tree.map(
        lambda a: jnp.where(there, a, 0),
        (*_differences(sightings, candidates), _symmetric(candidates.precision_tilt),
         _symmetric(candidates.precision)),
    )  # fmt: skip

    def error(W, of, rho=0.0, theta=0.0):
        moved = of(d_rho) + (of(by_x) * x + of(by_y) * y), of(d_theta) + yaw
        return _quadratic([of(w) for w in W], moved[0] - rho, moved[1] - theta)

    least = jnp.full((len(there), *poses), sensor.e_max)
    choice = jnp.full(least.shape, C)  # none
    for c in range(C):
        of_this = lambda a, c=c: of_poses(a[:, c])
        e = jnp.where(of_this(there), error(loose, of_this), jnp.inf)
        least, choice = jnp.where(e < least, e, least), jnp.where(e < least, c, choice)
    choice = jnp.where(used, choice, C)

    def of_choice(a):
        value = jnp.zeros(())
        for c in range(C):
            value = jnp.where(choice == c, of_poses(a[:, c]), value)
        return value

    J = jnp.where(sightings.valid[:, None, None], sightings.tilt, 0)
    by_tilt = [(J[:, 0, k, None], J[:, 1, k, None]) for k in range(2)]  # pitch, roll
    JW = [(W[0] * rho + W[1] * theta, W[1] * rho + W[2] * theta) for rho, theta in by_tilt]
    A = [JW[i][0] * by_tilt[j][0] + JW[i][1] * by_tilt[j][1] for i, j in ((0, 0), (0, 1), (1, 1))]
    b = [[r * d_rho + t * d_theta, r * by_x, r * by_y, t] for r, t in JW]
    chosen = choice[:, None] == of_poses(jnp.arange(C))
    sums = jnp.einsum(
        "smc,mc...->s...", jnp.stack([*A, *b[0], *b[1]]), chosen.astype(float),
        precision=jax.lax.Precision.HIGHEST,
    )  # fmt: skip
    gradient = [s[0] + s[1] * x + s[2] * y + s[3] * yaw for s in (sums[3:7], sums[7:])]
    tilt, _, prior = _solve_tilt(sensor, sums[:3], gradient)

    rho, theta = (of_poses(J[:, i, 0]) * tilt[0] + of_poses(J[:, i, 1]) * tilt[1] for i in range(2))
    tight = jnp.minimum(error(W, of_choice, rho, theta), sensor.e_max)
    tight = jnp.where(choice < C, tight, sensor.e_max)
    total = jnp.sum(jnp.where(of_poses(sightings.valid), tight, 0), axis=0)
    return Comparison(-0.5 * (total + prior), jnp.where(choice < C, choice, 0), tight, tilt)


def log_density(
    sensor: SensorModel,
    sightings: Sightings,
    candidates: Candidates,
    T_predicted_foot: SE2,
    known: Float[Array, "M"],
    lines: Float[Array, ""],
    log_elsewhere: Float[Array, ""],
) -> Float[Array, ""]:
    """log p(segments | pose), the soft form of `compare`, with its constants; to differentiate.

    Each sighting is one of the map's lines with the probability `known`, any of them alike, and
    anywhere in the image otherwise; the candidates stand for all lines, as the others are too far
    away to matter. The density is that of the end points across the line, per pixel², so that it
    falls when a sigma is too large or too small and compares different mounts. The wobble of the
    tilt is integrated out, about the value that the candidates, each by its share, make most
    likely: exactly, if the shares are certain.

    **Arguments:**
    - `known`: probabilities of the sightings, less than 1.
    - `lines`: how many of the map's lines are in view.
    - `log_elsewhere`: log density of a segment that is no line of the map, per pixel².
    """
    there = sightings.valid[:, None] & candidates.valid
    d_rho, d_theta, by_x, by_y = _differences(sightings, candidates)
    x, y = T_predicted_foot.xy
    moved = jnp.stack([d_rho + (by_x * x + by_y * y), d_theta + T_predicted_foot.yaw], axis=-1)
    difference = jnp.where(there[..., None], moved, 0)
    log_area = jnp.where(sightings.valid, sightings.log_area, 0)[:, None]
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
    J = jnp.broadcast_to(sightings.tilt[:, None], W.shape)
    JW = jnp.swapaxes(J, -1, -2) @ (share[:, :-1, None, None] * W)
    information = jnp.stack(_symmetric(jnp.sum(JW @ J, axis=(0, 1))))
    gradient = jnp.sum((JW @ difference[..., None])[..., 0], axis=(0, 1))
    tilt, volume, prior = _solve_tilt(sensor, information, gradient)
    _, total = log_mixture(difference - J @ tilt, W)
    return jnp.sum(jnp.where(sightings.valid, total, 0)) - 0.5 * (prior + jnp.log(volume))


def _differences(sightings: Sightings, candidates: Candidates) -> tuple[Float[Array, "M C"], ...]:
    """Observed less expected as the predicted foot would see it, and what moving the foot adds.

    **Returns:** the differences in rho and in theta, and what a metre along x and one along y add
    to that in rho; a turn adds itself to that in theta.
    """
    observed = jax.tree.map(lambda a: a[:, None], sightings.line)
    d_rho, d_theta = polar_differences(observed, candidates.line)
    nearing = (alignment(observed, candidates.line) * candidates.kappa)[..., None]
    by_foot = nearing * normal(candidates.line)
    return d_rho, d_theta, by_foot[..., 0], by_foot[..., 1]


def _symmetric(W: Float[Array, "*batch 2 2"]) -> tuple[Array, Array, Array]:
    return W[..., 0, 0], W[..., 0, 1], W[..., 1, 1]


def _quadratic(W, d_rho, d_theta):
    """e = dᵀ W d by W's elements: for a diagonal W the definition, (d_rho/sigma_rho)² + ..."""
    return W[0] * d_rho**2 + 2 * W[1] * d_rho * d_theta + W[2] * d_theta**2


def _solve_tilt(sensor, information, gradient):
    """The most likely wobble of errors d = J tilt + noise: A = Jᵀ W J and b = Jᵀ W d given.

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
