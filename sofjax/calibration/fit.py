"""The mount by least squares over pairs, and what it cannot know."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float

from sofjax.calibration.pairs import (
    TURNS,
    UNKNOWNS,
    Pairs,
    U,
    all_distances,
    start_at,
)
from sofjax.geometry.camera import Camera, Mount
from sofjax.smoothing.problem import robust

MOUNT = ("height", "pitch", "roll")  # what is free unless told otherwise


class FitConfig(eqx.Module):
    """What is free, what is known beforehand, and when an answer is one."""

    free: tuple[str, ...] = eqx.field(static=True, default=MOUNT)  # of UNKNOWNS
    # standard deviations: log height; pitch, roll, yaw in radians; the odometer's errors
    prior_sigma: tuple[float, ...] = (3.0, 1.0, 1.0, 1.0, 0.02, 0.05, 0.05, 0.005)
    loss_scale: float = 2.0  # residuals, in sigmas, from which they count linearly only
    # of an answer at most
    limit: tuple[float, ...] = (0.05, 0.02, 0.02, 0.02, 0.05, 0.1, 0.1, 0.01)
    pixel_sigma: float = 0.5  # noise of the end points that what seems to be known is held against
    min_pairs: int = 20


DEFAULT = FitConfig()
ODOMETER = slice(4, None)  # of UNKNOWNS
DOUBT = 2.0  # of `birge_ratio`: three errors are together so far off by chance in 1 of 140 drives


class CalibrationResult(eqx.Module):
    """A fitted mount, and how sure it is."""

    mount: Mount
    odometer: Float[Array, "4"]  # its systematic errors b, see `MotionModel`; 0 where not free
    covariance: Float[Array, "8 8"]  # of UNKNOWNS, in metres, radians and shares; 0 if not free
    residuals: Float[Array, "N 4"]  # pixels; 0 where a pair is not valid
    observable: Bool[Array, "8"]  # whether each of UNKNOWNS was free and the pairs fix it
    blind: Float[Array, "8"]  # the direction that is known least, in shares of `limit`, a unit ...
    blindness: Float[Array, ""]  # ... and its standard deviation in the same; > 1 is no answer
    # how far off its prior the odometer had to be put, root mean square in sigmas, 1 at least: the
    # covariance is wider by it
    birge_ratio: Float[Array, ""]
    cost: Float[Array, ""]  # half the sum of robust squares, in sigmas
    result: optx.RESULTS  # of the solver; an estimate that did not converge is the best so far


def fit_mount(
    camera: Camera, mount: Mount, pairs: Pairs, rules: FitConfig = DEFAULT, max_steps: int = 60
) -> CalibrationResult:
    """Find the mount that carries the floor's lines from image to image; Levenberg-Marquardt.

    Pure; `jax.vmap` runs it over logs and over starts, and its estimate has derivatives by all of
    `camera`, `pairs` and the mount's lever arm, by the implicit function theorem. Wants float64.

    Only the height over the odometer's scale of distance can be seen: with 'distance' free too,
    the priors share the two out.

    **Arguments:**
    - `mount`: where to begin, and the middle of the priors; what is not free stays as it is.
    - `pairs`: associations and sigmas, which stay as they are.
    """
    is_free = jnp.array([name in rules.free for name in UNKNOWNS])
    numbers = map(jnp.asarray, (rules.prior_sigma, rules.limit, rules.loss_scale, rules.min_pairs,
                                rules.pixel_sigma))  # fmt: skip
    return _fit(camera, mount, pairs, is_free, *numbers, max_steps)


@eqx.filter_jit  # one program, whatever is free
def _fit(
    camera, mount, pairs, is_free, prior, limit, loss_scale, min_pairs, pixel_sigma, max_steps
):
    start = start_at(mount)

    def residuals(by, pairs):
        by = jnp.where(is_free, by, 0)
        r = all_distances(camera, start.moved(by), pairs) / pairs.sigma
        r = jnp.where(pairs.valid[:, None], r, 0)
        # the four distances of a pair are two equations said from both sides: they count half
        return jax.vmap(robust, in_axes=(0, None))(r / 2**0.5, loss_scale)

    def with_priors(by, _):
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
    covariance = birge_ratio**2 * _sandwich(residuals, by, pairs, prior, pixel_sigma)
    covariance = jnp.where(is_free[:, None] & is_free, covariance, 0)
    spread, direction, sure = _blindness(limit, covariance)
    enough = jnp.sum(pairs.valid) >= min_pairs
    unit = jnp.ones(U).at[0].set(estimate.mount.height)  # log height to metres
    r, known = with_priors(by, None)
    return CalibrationResult(
        mount=estimate.mount,
        odometer=estimate.bias,
        covariance=covariance * jnp.outer(unit, unit),
        residuals=jnp.where(pairs.valid[:, None], all_distances(camera, estimate, pairs), 0),
        observable=is_free & sure & enough,
        blind=direction,
        blindness=spread,
        birge_ratio=birge_ratio,
        cost=0.5 * (jnp.sum(r**2) + jnp.sum(known**2)),
        result=found.result,
    )


def _sandwich(residuals, by, pairs: Pairs, prior, pixel_sigma) -> Float[Array, "8 8"]:
    """Covariance of the estimate from how the clusters disagree: A^-1 (Σ g gᵀ) A^-1.

    Errors of pairs that share images, a line or an odometer's reading are correlated, and the
    inverse information alone is too small by much. `g` is each cluster's gradient at the estimate,
    as it would be without that cluster's own pull on it (the jackknife).

    Few clusters may agree by chance: no direction is known better than by independent pairs that
    miss each other as these do.

    Noise turns segments that tell nothing into some that seem to tell a little, and if all there
    is is noise then that adds up: what jittered segments would tell is not counted in A.
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
    told = jacobian(by, jittered) - J
    told = jnp.einsum("nri,nrj->ij", told, told)
    from_left = lambda M: jax.scipy.linalg.solve_triangular(L, M, lower=True)
    share, axes = jnp.linalg.eigh(from_left(from_left(told).T))
    P = axes / (1 - jnp.clip(share, 0, 0.99)) @ axes.T
    values, axes = jnp.linalg.eigh(P @ from_left(from_left(middle).T) @ P.T)
    count = 2 * jnp.sum(pairs.valid.astype(r.dtype))
    independent = jnp.sum(r**2) / jnp.maximum(count, 1)
    root = from_left(jnp.eye(U)).T @ axes
    return root * jnp.maximum(values, independent) @ root.T


def _birge_ratio(off, is_free) -> Float[Array, ""]:
    """How far values lie off their priors, root mean square in sigmas; 1 at least (Birge's ratio).

    What the clusters share, such as a wrong lens or clock, no covariance from their differences
    shows: it shows in an odometer that must be further off than odometers are.
    """
    count = jnp.maximum(jnp.sum(is_free.astype(off.dtype)), 1)
    return jnp.sqrt(jnp.maximum(jnp.sum(jnp.where(is_free, off, 0) ** 2) / count, 1))


def _blindness(limit, covariance):
    """The widest direction of the covariance in units of what an answer may have at most."""
    values, vectors = jnp.linalg.eigh(covariance / jnp.outer(limit, limit))
    spread = jnp.sqrt(jnp.maximum(values[-1], 0))
    return spread, vectors[:, -1], jnp.diag(covariance) < limit**2


def verdict(found: CalibrationResult, rules: FitConfig, pairs: Pairs) -> tuple[bool, str]:
    """Whether a fit is an answer, and in words what could not be observed."""
    count, limit = int(pairs.valid.sum()), rules.limit
    if count < rules.min_pairs:
        return False, (
            f"{count} pairs of segments on the floor were found, and {rules.min_pairs} are needed: "
            "the drive shows too few lines on the floor, or is too short"
        )
    sigma = jnp.sqrt(jnp.diag(found.covariance)).at[0].divide(found.mount.height)
    wide = [
        f"the {_ERRORS.get(name, name)} ({_amount(name, float(s))})"
        for name, s, most in zip(UNKNOWNS, sigma, limit, strict=True)
        if name in rules.free and name not in TURNS and s > most  # nobody asked for the turns
    ]
    if wide:
        doubt = doubts(found)
        return False, f"not observable from this drive: {' and '.join(wide)}; {doubt or _WHY}"
    if found.result != optx.RESULTS.successful:
        return False, "the fit did not converge"
    return True, ""


def doubts(found: CalibrationResult) -> str:
    """What speaks against a fit that converged, in words; empty if nothing."""
    birge_ratio = float(found.birge_ratio)
    if birge_ratio < DOUBT:
        return ""
    return (
        f"it takes an odometer {birge_ratio:.1f} times further off than odometers are, "
        "so camera, clock or odometer are not what they are taken for, and the errors told are "
        "wider by as much"
    )


_WHY = (
    "the height takes driving some metres, not turning on the spot, over lines that lie across the "
    "way, and the tilt lines that come nearer"
)


_ERRORS = {
    "distance": "odometer's error in distance",
    "left": "odometer's error in left turns",
    "right": "odometer's error in right turns",
    "curvature": "odometer's pull to one side",
}


def _amount(name: str, sigma: float) -> str:
    if name in ("height", "distance", "left", "right"):
        return f"known to {100 * sigma:.2g} %"
    if name == "curvature":
        return f"known to {sigma * 57.29578:.2g}° a metre"
    return f"known to {sigma * 57.29578:.2g}°"
