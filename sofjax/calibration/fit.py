"""The mount by least squares over pairs, with its covariance and what the pairs do not show."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from sofjax._checks import check_fields
from sofjax.calibration.pairs import (
    UNKNOWNS,
    SegmentPairs,
    U,
    all_distances,
    start_at,
)
from sofjax.geometry.camera import Camera, Mount
from sofjax.smoothing.problem import robust

MOUNT = ("height", "pitch", "roll")  # what is free by default


class FitConfig(eqx.Module):
    """What is free, what is known beforehand, and how well an answer must be known."""

    free: tuple[str, ...] = eqx.field(static=True, default=MOUNT)  # of UNKNOWNS
    # standard deviations: log height; pitch, roll, yaw in radians; the odometer's errors
    prior_sigma: tuple[float, ...] = (3.0, 1.0, 1.0, 1.0, 0.02, 0.05, 0.05, 0.005)
    loss_scale: float = 2.0  # residuals, in sigmas, from which they count linearly only
    # the largest standard deviations of an answer, in the units of `prior_sigma`
    limit: tuple[float, ...] = (0.05, 0.02, 0.02, 0.02, 0.05, 0.1, 0.1, 0.01)
    pixel_sigma: float = 0.5  # pixels: jitter whose information does not count, see `_sandwich`
    min_pairs: int = 20
    # a larger Birge ratio is a doubt; three odometer errors exceed it by chance in 1 of 140 drives
    max_birge_ratio: float = 2.0

    def __check_init__(self) -> None:
        check_fields(
            self,
            positive=("loss_scale", "pixel_sigma", "max_birge_ratio"),
            whole_from={"min_pairs": 1},
        )
        for name in self.free:
            if name not in UNKNOWNS:
                raise ValueError(
                    f"FitConfig.free must be some of {', '.join(UNKNOWNS)}, not {name!r}"
                )
        for field in ("prior_sigma", "limit"):
            numbers = getattr(self, field)
            plain = all(isinstance(n, int | float | np.number) for n in numbers)
            if len(numbers) != U or (plain and not all(0 < n < np.inf for n in numbers)):
                raise ValueError(f"FitConfig.{field} must be {U} numbers above 0, not {numbers!r}")


DEFAULT = FitConfig()
ODOMETER = slice(4, None)  # of UNKNOWNS


class CalibrationResult(eqx.Module):
    """A fitted mount, and how well it is known."""

    mount: Mount
    odometer: Float[Array, "4"]  # its systematic errors b, see `MotionModel`; 0 where not free
    covariance: Float[Array, "8 8"]  # of UNKNOWNS, in metres, radians and shares; 0 if not free
    residuals: Float[Array, "N 4"]  # pixels; 0 where a pair is not valid
    observable: Bool[Array, "8"]  # whether each of UNKNOWNS was free and the pairs fix it
    # the direction that is known least: a unit vector in shares of `limit`, and its standard
    # deviation in the same shares; above 1 the fit is no answer
    weakest: Float[Array, "8"]
    weakest_sigma: Float[Array, ""]
    # RMS of the odometer's errors over their priors, in sigmas, at least 1; the covariance is
    # multiplied by its square
    birge_ratio: Float[Array, ""]
    cost: Float[Array, ""]  # half the sum of robust squares, in sigmas
    result: optx.RESULTS  # of the solver; an estimate that did not converge is the best so far


class _Terms(eqx.Module):
    """What `_fit` takes of its settings, as arrays: one compiled program for all of them."""

    is_free: Bool[Array, "8"]
    prior_sigma: Float[Array, "8"]
    limit: Float[Array, "8"]
    loss_scale: Float[Array, ""]
    min_pairs: Int[Array, ""]
    pixel_sigma: Float[Array, ""]


Residuals = Callable[[Float[Array, "8"], SegmentPairs], Float[Array, "N 4"]]


def fit_mount(
    camera: Camera,
    mount: Mount,
    pairs: SegmentPairs,
    config: FitConfig = DEFAULT,
    max_steps: int = 60,
) -> CalibrationResult:
    """The mount that carries the floor's lines from image to image; Levenberg-Marquardt.

    Pure; `jax.vmap` runs it over logs and over starts, and its estimate has derivatives by all of
    `camera`, `pairs` and the mount's lever arm, by the implicit function theorem. Wants float64.

    Only the ratio of the height to the odometer's scale of distance is observable. With 'distance'
    free too, the priors decide how the two share it.

    **Arguments:**
    - `mount`: where to begin, and the mean of the priors; what is not free stays as it is.
    - `pairs`: associations and sigmas, which stay as they are.
    """
    terms = _Terms(
        is_free=jnp.array([name in config.free for name in UNKNOWNS]),
        prior_sigma=jnp.asarray(config.prior_sigma),
        limit=jnp.asarray(config.limit),
        loss_scale=jnp.asarray(config.loss_scale),
        min_pairs=jnp.asarray(config.min_pairs),
        pixel_sigma=jnp.asarray(config.pixel_sigma),
    )
    return _fit(camera, mount, pairs, terms, max_steps)


@eqx.filter_jit  # one program, whatever is free
def _fit(
    camera: Camera, mount: Mount, pairs: SegmentPairs, terms: _Terms, max_steps: int
) -> CalibrationResult:
    start = start_at(mount)
    is_free, prior = terms.is_free, terms.prior_sigma

    def residuals(by: Float[Array, "8"], pairs: SegmentPairs) -> Float[Array, "N 4"]:
        by = jnp.where(is_free, by, 0)
        r = all_distances(camera, start.moved(by), pairs) / pairs.sigma
        r = jnp.where(pairs.valid[:, None], r, 0)
        # the four distances of a pair are two equations stated from both sides: they count half
        return jax.vmap(robust, in_axes=(0, None))(r / 2**0.5, terms.loss_scale)

    def with_priors(
        by: Float[Array, "8"], _: None
    ) -> tuple[Float[Array, "N 4"], Float[Array, "8"]]:
        return residuals(by, pairs), jnp.where(is_free, by / prior, by)

    found = optx.least_squares(
        with_priors,
        optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8, linear_solver=lx.Normal(lx.Cholesky())),
        jnp.zeros(U),
        max_steps=max_steps,
        throw=False,
    )
    by = jnp.where(is_free, found.value, 0)
    estimate = start.moved(by)
    birge_ratio = _birge_ratio(by[ODOMETER] / prior[ODOMETER], is_free[ODOMETER])
    covariance = birge_ratio**2 * _sandwich(residuals, by, pairs, prior, terms.pixel_sigma)
    covariance = jnp.where(is_free[:, None] & is_free, covariance, 0)
    weakest_sigma, weakest, known_well = _weakest(terms.limit, covariance)
    enough = jnp.sum(pairs.valid) >= terms.min_pairs
    unit = jnp.ones(U).at[0].set(estimate.mount.height)  # log height to metres
    r, r_priors = with_priors(by, None)
    return CalibrationResult(
        mount=estimate.mount,
        odometer=estimate.bias,
        covariance=covariance * jnp.outer(unit, unit),
        residuals=jnp.where(pairs.valid[:, None], all_distances(camera, estimate, pairs), 0),
        observable=is_free & known_well & enough,
        weakest=weakest,
        weakest_sigma=weakest_sigma,
        birge_ratio=birge_ratio,
        cost=0.5 * (jnp.sum(r**2) + jnp.sum(r_priors**2)),
        result=found.result,
    )


def _sandwich(
    residuals: Residuals,
    by: Float[Array, "8"],
    pairs: SegmentPairs,
    prior: Float[Array, "8"],
    pixel_sigma: Float[Array, ""],
) -> Float[Array, "8 8"]:
    """Covariance of the estimate from how the clusters disagree: A^-1 (Σ g gᵀ) A^-1.

    Errors of pairs that share images, a line or an odometer's reading are correlated: the inverse
    information alone is much too small. `g` is each cluster's gradient at the estimate, as it
    would be had the cluster not taken part in the fit (the jackknife).

    A few clusters may agree by chance. So no direction gets a variance below that of independent
    pairs with residuals as large as these.

    Noise of the end points makes some segments look informative that are not. The information
    that jittered segments would add is measured, and not counted in A.
    """
    jacobian = jax.jacfwd(residuals)
    J, r = jacobian(by, pairs), residuals(by, pairs)
    K = jnp.diag(1 / prior)
    A = jnp.einsum("nri,nrj->ij", J, J) + K @ K
    by_cluster = lambda x: jax.ops.segment_sum(x, pairs.cluster, len(x))
    g = by_cluster(jnp.einsum("nri,nr->ni", J, r))
    own = by_cluster(jnp.einsum("nri,nrj->nij", J, J))
    g = jax.vmap(lambda own, g: A @ jnp.linalg.solve(A - own, g))(own, g)  # (1 - own A^-1)^-1 g
    middle = g.T @ g + K @ K

    keys = jax.random.split(jax.random.key(0))
    jitter = [pixel_sigma * jax.random.rademacher(k, pairs.first.shape, float) for k in keys]
    jittered = eqx.tree_at(
        lambda p: (p.first, p.second), pairs, (pairs.first + jitter[0], pairs.second + jitter[1])
    )
    L = jnp.linalg.cholesky(A)
    from_noise = jacobian(by, jittered) - J
    from_noise = jnp.einsum("nri,nrj->ij", from_noise, from_noise)
    from_left = lambda M: jax.scipy.linalg.solve_triangular(L, M, lower=True)
    share, axes = jnp.linalg.eigh(from_left(from_left(from_noise).T))
    P = axes / (1 - jnp.clip(share, 0, 0.99)) @ axes.T
    values, axes = jnp.linalg.eigh(P @ from_left(from_left(middle).T) @ P.T)
    count = 2 * jnp.sum(pairs.valid.astype(r.dtype))
    independent = jnp.sum(r**2) / jnp.maximum(count, 1)
    root = from_left(jnp.eye(U)).T @ axes
    return root * jnp.maximum(values, independent) @ root.T


def _birge_ratio(off: Float[Array, "4"], is_free: Bool[Array, "4"]) -> Float[Array, ""]:
    """RMS of how far values lie off their priors, in sigmas, at least 1 (Birge's ratio).

    An error that all clusters share, such as a wrong lens or clock, does not show in their
    differences. It shows in an odometer that must be further off than odometers are.
    """
    count = jnp.maximum(jnp.sum(is_free.astype(off.dtype)), 1)
    return jnp.sqrt(jnp.maximum(jnp.sum(jnp.where(is_free, off, 0) ** 2) / count, 1))


def _weakest(
    limit: Float[Array, "8"], covariance: Float[Array, "8 8"]
) -> tuple[Float[Array, ""], Float[Array, "8"], Bool[Array, "8"]]:
    """The widest direction of the covariance in units of `limit`: its sigma, and a unit vector.

    The last value is, for each unknown, whether its own standard deviation is below its limit.
    """
    values, vectors = jnp.linalg.eigh(covariance / jnp.outer(limit, limit))
    spread = jnp.sqrt(jnp.maximum(values[-1], 0))
    return spread, vectors[:, -1], jnp.diag(covariance) < limit**2
