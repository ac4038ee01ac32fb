"""The rig by least squares over pairs, with its covariance and what the pairs do not show."""

import math
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
    MOUNT,
    ODOMETER,
    UNKNOWNS,
    Estimate,
    Seen,
    SegmentPairs,
    U,
    all_distances,
    distances,
    seen_near,
)
from sofjax.geometry.camera import Mount
from sofjax.smoothing.problem import robust

HALF_DEGREE = math.radians(0.5)
# standard deviations of what is known beforehand of each of UNKNOWNS, in the units of `RIG` and of
# the odometer's errors, and those from which on an answer is none
PRIOR = dict(
    height=3.0, pitch=1.0, roll=1.0, yaw=0.1, x=0.5, y=0.5, focal=0.05, cx=0.02, cy=0.02, k1=0.05,
    k2=0.05, time_offset=0.2, line_delay=5e-5, distance=0.01, left=0.05, right=0.05,
    curvature=0.005,
)  # fmt: skip
LIMIT = dict(
    height=0.05, pitch=HALF_DEGREE, roll=HALF_DEGREE, yaw=HALF_DEGREE, x=0.1, y=0.1, focal=0.01,
    cx=0.01, cy=0.01, k1=0.02, k2=0.02, time_offset=0.01, line_delay=1e-5, distance=0.05,
    left=0.1, right=0.1, curvature=0.01,
)  # fmt: skip


class FitConfig(eqx.Module):
    """What is free, what is known beforehand, and how well an answer must be known."""

    free: tuple[str, ...] = eqx.field(static=True, default=MOUNT[:3])  # of UNKNOWNS
    prior_sigma: tuple[float, ...] = tuple(PRIOR.values())  # of each of UNKNOWNS
    loss_scale: float = 2.0  # residuals, in sigmas, from which they count linearly only
    limit: tuple[float, ...] = tuple(LIMIT.values())  # the largest standard deviations of an answer
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


class CalibrationResult(eqx.Module):
    """A fitted rig, and how well it is known."""

    estimate: Estimate  # what is not free stays as it was
    covariance: Float[Array, "17 17"]  # of `estimate.by`; 0 if not free
    residuals: Float[Array, "N 4"]  # pixels; 0 where a pair is not valid
    observable: Bool[Array, "17"]  # whether each of UNKNOWNS was free and the pairs fix it
    # the direction that is known least: a unit vector in shares of `limit`, and its standard
    # deviation in the same shares; above 1 the fit is no answer
    weakest: Float[Array, "17"]
    weakest_sigma: Float[Array, ""]
    # RMS of the odometer's errors over their priors, in sigmas, at least 1; the covariance is
    # multiplied by its square
    birge_ratio: Float[Array, ""]
    cost: Float[Array, ""]  # half the sum of robust squares, in sigmas
    result: optx.RESULTS  # of the solver; an estimate that did not converge is the best so far

    @property
    def mount(self) -> Mount:
        return self.estimate.rig.mount

    @property
    def odometer(self) -> Float[Array, "4"]:
        """Its systematic errors b, see `MotionModel`; 0 where not free."""
        return self.estimate.bias


class _Terms(eqx.Module):
    """What `_fit` takes of its settings, as arrays: one compiled program for all of them."""

    is_free: Bool[Array, "17"]
    prior_sigma: Float[Array, "17"]
    limit: Float[Array, "17"]
    loss_scale: Float[Array, ""]
    min_pairs: Int[Array, ""]
    pixel_sigma: Float[Array, ""]


Residuals = Callable[[Float[Array, "17"], Seen], Float[Array, "N 4"]]


def fit_rig(
    start: Estimate, pairs: SegmentPairs, config: FitConfig = DEFAULT, max_steps: int = 60
) -> CalibrationResult:
    """The rig that carries the floor's lines from image to image; Levenberg-Marquardt.

    Pure; `jax.vmap` runs it over logs and over starts, and its estimate has derivatives by all of
    `start.given` and `pairs`, by the implicit function theorem. Wants float64.

    Only the ratio of the height to the odometer's scale of distance is observable. With 'distance'
    free too, the priors decide how the two share it.

    **Arguments:**
    - `start`: where to begin; the priors are about `start.given`, and what is not free stays.
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
    return _fit(start, pairs, terms, max_steps)


@eqx.filter_jit  # one program, whatever is free
def _fit(start: Estimate, pairs: SegmentPairs, terms: _Terms, max_steps: int) -> CalibrationResult:
    is_free, prior = terms.is_free, terms.prior_sigma
    at = lambda by: Estimate(start.given, jnp.where(is_free, by, start.by))

    # lens, clock and shutter to first order about the start; rounds make them exact
    seen, by_estimate = jax.vmap(seen_near, in_axes=(None, 0))(start, pairs)

    def residuals(by: Float[Array, "17"], seen: Seen) -> Float[Array, "N 4"]:
        estimate = at(by)
        r = jax.vmap(distances, in_axes=(None, 0))(
            estimate, seen.moved(by_estimate @ (estimate.by - start.by))
        )
        r = jnp.where(pairs.valid[:, None], r / pairs.sigma, 0)
        # the four distances of a pair are two equations stated from both sides: they count half
        return jax.vmap(robust, in_axes=(0, None))(r / 2**0.5, terms.loss_scale)

    def with_priors(
        by: Float[Array, "17"], _: None
    ) -> tuple[Float[Array, "N 4"], Float[Array, "17"]]:
        return residuals(by, seen), jnp.where(is_free, by / prior, by - start.by)

    found = optx.least_squares(
        with_priors,
        optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6, linear_solver=lx.Normal(lx.Cholesky())),
        start.by,
        max_steps=max_steps,
        throw=False,
    )
    estimate = at(found.value)
    birge_ratio = _birge_ratio(estimate.bias / prior[ODOMETER], is_free[ODOMETER])
    covariance = birge_ratio**2 * _sandwich(
        residuals, estimate.by, pairs, seen, prior, terms.pixel_sigma
    )
    covariance = jnp.where(is_free[:, None] & is_free, covariance, 0)
    weakest_sigma, weakest, known_well = _weakest(terms.limit, covariance)
    enough = jnp.sum(pairs.valid) >= terms.min_pairs
    r, r_priors = with_priors(found.value, None)
    return CalibrationResult(
        estimate=estimate,
        covariance=covariance,
        residuals=jnp.where(pairs.valid[:, None], all_distances(estimate, pairs), 0),
        observable=is_free & known_well & enough,
        weakest=weakest,
        weakest_sigma=weakest_sigma,
        birge_ratio=birge_ratio,
        cost=0.5 * (jnp.sum(r**2) + jnp.sum(r_priors**2)),
        result=found.result,
    )


def _sandwich(
    residuals: Residuals,
    by: Float[Array, "17"],
    pairs: SegmentPairs,
    seen: Seen,
    prior: Float[Array, "17"],
    pixel_sigma: Float[Array, ""],
) -> Float[Array, "17 17"]:
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
    J, r = jacobian(by, seen), residuals(by, seen)
    K = jnp.diag(1 / prior)
    A = jnp.einsum("nri,nrj->ij", J, J) + K @ K
    by_cluster = lambda x: jax.ops.segment_sum(x, pairs.cluster, len(x))
    g = by_cluster(jnp.einsum("nri,nr->ni", J, r))
    own = by_cluster(jnp.einsum("nri,nrj->nij", J, J))
    g = jax.vmap(lambda own, g: A @ jnp.linalg.solve(A - own, g))(own, g)  # (1 - own A^-1)^-1 g
    middle = g.T @ g + K @ K

    keys = jax.random.split(jax.random.key(0))
    jitter = [pixel_sigma * jax.random.rademacher(k, seen.first.shape, float) for k in keys]
    jittered = Seen(seen.first + jitter[0], seen.second + jitter[1], seen.T_first_second)
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
    limit: Float[Array, "17"], covariance: Float[Array, "17 17"]
) -> tuple[Float[Array, ""], Float[Array, "17"], Bool[Array, "17"]]:
    """The widest direction of the covariance in units of `limit`: its sigma, and a unit vector.

    The last value is, for each unknown, whether its own standard deviation is below its limit.
    """
    values, vectors = jnp.linalg.eigh(covariance / jnp.outer(limit, limit))
    spread = jnp.sqrt(jnp.maximum(values[-1], 0))
    return spread, vectors[:, -1], jnp.diag(covariance) < limit**2
