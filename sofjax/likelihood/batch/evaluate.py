"""log L of N particles, M observed and K map segments; section III.A for whole clouds at once."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float

from sofjax.extraction.sof import put_on_floor
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.likelihood.batch.arguments import check_image, check_problem
from sofjax.likelihood.batch.culling import is_exact, reach
from sofjax.likelihood.batch.kernels import hard
from sofjax.likelihood.batch.prepare import Cloud, Lines, Seen, compare_pairs, prepare
from sofjax.likelihood.batch.soft import soft as soft_rows
from sofjax.likelihood.batch.soft import soft_weight
from sofjax.likelihood.sensor_model import LineNoise, Scalar

FEW_PAIRS = 2**16  # up to here all pairs are evaluated side by side


class Form(NamedTuple):
    """Which program is compiled."""

    soft: bool
    prune: bool = True
    fall_back: bool = True  # evaluate every pair where the bounds of the pruning do not hold


def log_likelihood(
    particles: SE2,
    observed: Segments,
    segment_map: Segments,
    noise: LineNoise,
    *,
    soft: bool = False,
    used: Bool[Array, "N M"] | None = None,
    covariance: Float[Array, "M 2 2"] | None = None,
    prune: bool = True,
) -> Float[Array, "N"]:
    """How well each of N poses explains M observed segments by a map of K.

    Hard: log L = -1/2 sum_m min(min_k e, e_max) over pairs that overlap, with
    e = (d_rho / sigma_rho)² + (d_theta / sigma_theta)², each line named from the side of the other.
    An observed segment that meets nothing costs e_max, once. The overlap is taken along the
    observed segment, after the map is moved into the robot frame.

    Soft: log L = sum_m log(exp(-e_max / 2) + sum_k exp(-(e + (gap / tau)²) / 2)), the form to
    differentiate: by poses, observed segments, map, sigmas and e_max, forwards (to any order) and
    backwards (once; a Hessian is `jax.hessian`, forwards over backwards). Instead of being shut
    out, a pair that does not overlap pays for its gap in metres; tau -> 0 is the hard rule. In
    float32 e_max counts as no more than 150 here. The hard form has no derivative, and says so
    where one is asked for.

    No array of the size N·M·K is made. Few pairs are evaluated side by side; of many, those that
    no particle of the cloud can bring together are left out, which changes nothing else.

    **Arguments:**
    - `particles`: N poses T_world_robot, metres and radians.
    - `observed`: M segments in the robot frame, metres.
    - `segment_map`: K segments in the world, metres.
    - `noise`: of every pair, and the outlier cost.
    - `used`: which observed segments count for which particle, where the choice depends on it. What
      does not count costs nothing: of particles with different choices the sums do not compare.
    - `covariance`: of (rho, theta) of each observed segment, added to that of the noise.
    - `prune`: False evaluates every pair, for comparison.

    **Returns:** log L of each particle, without constants. A ValueError names an argument that
    cannot be used. Under `jit` values are not looked at: a particle that is not finite then gets
    a value without meaning and spoils no other.
    """
    noise = check_problem(particles, observed, segment_map, noise, used, covariance)
    form = Form(soft, prune)
    return _log_likelihood(form, particles, observed, segment_map, noise, used, covariance)[0]


def log_likelihood_pruned(
    particles: SE2,
    observed: Segments,
    segment_map: Segments,
    noise: LineNoise,
    *,
    soft: bool = False,
    used: Bool[Array, "N M"] | None = None,
    covariance: Float[Array, "M 2 2"] | None = None,
) -> tuple[Float[Array, "N"], Bool[Array, ""]]:
    """`log_likelihood` with pairs out of reach left out, whatever the sizes.

    **Returns:** log L, and whether it is exact. It is, unless the noise of theta is so wide that
    lines at right angles cost less than e_max: such pairs, of the hard form, may then be compared
    from the wrong side. `log_likelihood` evaluates every pair in that case.
    """
    noise = check_problem(particles, observed, segment_map, noise, used, covariance)
    form = Form(soft, fall_back=False)
    return _log_likelihood(form, particles, observed, segment_map, noise, used, covariance)


def image_log_likelihood(
    camera: Camera,
    mount: Mount,
    particles: SE2,
    segments_image: Segments,
    segment_map: Segments,
    noise: LineNoise,
    *,
    max_depth: Scalar = 8.0,
    soft: bool = False,
) -> Float[Array, "N"]:
    """`log_likelihood` of an image's segments: put on the floor inside, eq. (13), so that with
    `soft` the mount may be differentiated by too.

    **Arguments:**
    - `camera`, `mount`: pixels; metres and radians. Height, pitch, roll, yaw and the lever arm
      may be differentiated by.
    - `segments_image`: M segments, pixels of the undistorted image. What lies above the horizon
      or beyond `max_depth` metres does not count.
    """
    check_image(camera, mount, segments_image)
    observed = put_on_floor(camera, mount, segments_image, max_depth)
    return log_likelihood(particles, observed, segment_map, noise, soft=soft)


@jax.custom_jvp
def _without_derivative(given: Any) -> Any:
    """The same; a derivative is refused instead of returned as zero."""
    return given


@functools.partial(_without_derivative.defjvp, symbolic_zeros=True)
def _refuse_derivative(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    leaves = jax.tree.leaves(tangents, is_leaf=lambda leaf: isinstance(leaf, SymbolicZero))
    if not all(isinstance(leaf, SymbolicZero) for leaf in leaves):
        raise ValueError(
            "log_likelihood: the hard form has no derivative; pass soft=True for the form to "
            "differentiate"
        )
    return primals[0], tangents[0]


@functools.partial(jax.jit, static_argnums=0)
def _log_likelihood(
    form: Form,
    particles: SE2,
    observed: Segments,
    segment_map: Segments,
    noise: LineNoise,
    used: Bool[Array, "N M"] | None,
    covariance: Float[Array, "M 2 2"] | None,
) -> tuple[Float[Array, "N"], Bool[Array, ""] | bool]:
    N, M, K = len(particles.yaw), len(observed.valid), len(segment_map.valid)
    counts = observed.valid[:, None] if used is None else observed.valid[:, None] & used.T
    e_max, tau = jnp.asarray(noise.e_max), jnp.asarray(noise.gap_scale)
    counts = counts.astype(e_max.dtype)
    diagonal = covariance is None
    constant = jnp.diag(jnp.stack([noise.rho_sigma, noise.theta_sigma]) ** 2)
    covariance = jnp.broadcast_to(constant, (M, 2, 2)) if diagonal else covariance + constant
    cloud, seen, lines = prepare(particles, observed, segment_map, covariance)
    if form.soft:
        e_max = jnp.minimum(e_max, 1.7 * jnp.log(jnp.finfo(e_max.dtype).max))
    pairs = N * M * K
    few = pairs == 0 or (form.fall_back and form.prune and pairs <= FEW_PAIRS)

    if form.soft and few:
        u = soft_weight(*_side_by_side(cloud, seen, lines), e_max, tau).sum(axis=0)
        return (counts * (jnp.log1p(u) - 0.5 * e_max)).sum(axis=0), True
    if form.soft:
        return soft_rows(diagonal, form.prune, cloud, seen, lines, e_max, tau, counts), True
    cloud, seen, lines, e_max = _without_derivative((cloud, seen, lines, e_max))
    if few:
        e = _every_error(*_side_by_side(cloud, seen, lines)).min(axis=0, initial=jnp.inf)
        return -0.5 * (counts * jnp.minimum(e, e_max)).sum(axis=0), True
    cloud, seen, lines = lax.stop_gradient((cloud, seen, lines))
    exact = is_exact(seen, e_max)
    near = reach(cloud, seen, lines, e_max, jnp.zeros_like(e_max), form.prune, diagonal)
    values = hard(cloud, seen, near, e_max, counts, diagonal)
    if form.fall_back:
        values = jnp.where(exact, values, _pair_by_pair(cloud, seen, lines, e_max, counts, ~exact))
    return values, exact


def _side_by_side(cloud: Cloud, seen: Seen, lines: Lines) -> tuple[Cloud, Seen, Lines]:
    """Leading axes so that all pairs broadcast to [K, M, N]."""
    seen = jax.tree.map(lambda leaf: leaf[:, None], seen)
    lines = jax.tree.map(lambda leaf: leaf[:, None, None], lines)
    return cloud, seen, lines


def _every_error(cloud: Cloud, seen: Seen, lines: Lines) -> Array:
    z_rho, z_theta, past, before = compare_pairs(cloud, seen, lines)
    overlap = (past < 0) & (before < 0) & seen.matchable & lines.matchable
    return jnp.where(overlap, z_rho**2 + z_theta**2, jnp.inf)


def _pair_by_pair(
    cloud: Cloud, seen: Seen, lines: Lines, e_max: Array, counts: Array, needed: Array
) -> Float[Array, "N"]:
    """Slow and right for any noise; no loop at all unless it is needed."""
    take = lambda tree, i: jax.tree.map(lambda leaf: leaf[i], tree)

    def over_map(m: Array) -> Array:
        error = lambda k: _every_error(cloud, take(seen, m), take(lines, k))
        nearest = lambda k, best: jnp.minimum(best, error(k))
        return lax.fori_loop(0, len(lines.rho), nearest, jnp.full_like(cloud.x, e_max))

    add = lambda m, total: total - 0.5 * counts[m] * over_map(m)
    return lax.fori_loop(0, jnp.where(needed, len(seen.rho), 0), add, jnp.zeros_like(cloud.x))
