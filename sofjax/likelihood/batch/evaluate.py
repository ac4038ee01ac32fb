"""log L of N particles, M observed and K map segments; section III.A for whole clouds at once."""

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from sofjax.extraction.sof import put_on_floor
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.likelihood.batch.culling import is_exact, reach
from sofjax.likelihood.batch.kernels import hard
from sofjax.likelihood.batch.prepare import compare_pairs, prepare
from sofjax.likelihood.batch.soft import soft as soft_rows
from sofjax.likelihood.batch.soft import soft_weight

Scalar = Float[Array, ""] | float

FEW_PAIRS = 2**16  # up to here all pairs are evaluated side by side


def log_likelihood(
    particles: SE2,
    observed: Segments,
    segment_map: Segments,
    sigma_rho: Scalar,
    sigma_theta: Scalar,
    e_max: Scalar,
    *,
    soft: bool = False,
    used: Bool[Array, "N M"] | None = None,
    covariance: Float[Array, "M 2 2"] | None = None,
    overlap_scale: Scalar = 0.05,
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
    out, a pair that does not overlap pays for its gap in metres; tau = `overlap_scale` -> 0 is the
    hard rule. In float32 e_max counts as no more than 150 here. The hard form has no derivative.

    No array of the size N·M·K is made. Few pairs are evaluated side by side; of many, those that
    no particle of the cloud can bring together are left out, which changes nothing else.

    **Arguments:**
    - `particles`: N poses T_world_robot, metres and radians.
    - `observed`: M segments in the robot frame, metres.
    - `segment_map`: K segments in the world, metres.
    - `sigma_rho`, `sigma_theta`: metres and radians, noise of every pair.
    - `e_max`: the cost of an observed segment that meets nothing.
    - `used`: which observed segments count for which particle, where the choice depends on it. What
      does not count costs nothing: of particles with different choices the sums do not compare.
    - `covariance`: of (rho, theta) of each observed segment, added to that of the sigmas.
    - `prune`: False evaluates every pair, for comparison.

    **Returns:** log L of each particle, without constants.
    """
    return _log_likelihood(
        particles, observed, segment_map,
        *_scalars(particles, sigma_rho, sigma_theta, e_max, overlap_scale),
        used, covariance, soft=soft, prune=prune, fall_back=True,
    )[0]  # fmt: skip


def log_likelihood_pruned(
    particles: SE2,
    observed: Segments,
    segment_map: Segments,
    sigma_rho: Scalar,
    sigma_theta: Scalar,
    e_max: Scalar,
    *,
    soft: bool = False,
    used: Bool[Array, "N M"] | None = None,
    covariance: Float[Array, "M 2 2"] | None = None,
    overlap_scale: Scalar = 0.05,
) -> tuple[Float[Array, "N"], Bool[Array, ""]]:
    """`log_likelihood` with pairs out of reach left out, whatever the sizes.

    **Returns:** log L, and whether it is exact. It is, unless the noise of theta is so wide that
    lines at right angles cost less than e_max: such pairs, of the hard form, may then be compared
    from the wrong side. `log_likelihood` evaluates every pair in that case.
    """
    return _log_likelihood(
        particles, observed, segment_map,
        *_scalars(particles, sigma_rho, sigma_theta, e_max, overlap_scale),
        used, covariance, soft=soft, prune=True, fall_back=False,
    )  # fmt: skip


def image_log_likelihood(
    camera: Camera,
    mount: Mount,
    particles: SE2,
    segments_image: Segments,
    segment_map: Segments,
    sigma_rho: Scalar,
    sigma_theta: Scalar,
    e_max: Scalar,
    *,
    max_depth: Scalar = 8.0,
    soft: bool = True,
    used: Bool[Array, "N M"] | None = None,
    covariance: Float[Array, "M 2 2"] | None = None,
    overlap_scale: Scalar = 0.05,
) -> Float[Array, "N"]:
    """`log_likelihood` of an image's segments: put on the floor inside, so that the mount is a
    variable too.

    **Arguments:**
    - `camera`, `mount`: pixels; metres and radians. Height, pitch, roll, yaw and the lever arm
      may be differentiated by.
    - `segments_image`: M segments, pixels of the undistorted image. What lies above the horizon
      or beyond `max_depth` metres does not count.
    """
    observed = put_on_floor(camera, mount, segments_image, max_depth)
    return log_likelihood(
        particles, observed, segment_map, sigma_rho, sigma_theta, e_max,
        soft=soft, used=used, covariance=covariance, overlap_scale=overlap_scale,
    )  # fmt: skip


def _scalars(particles, *values):
    """As arrays, so that a new value is not a new program."""
    return (jnp.asarray(value, particles.xy.dtype) for value in values)


@functools.partial(jax.jit, static_argnames=("soft", "prune", "fall_back"))
def _log_likelihood(
    particles, observed, segment_map, sigma_rho, sigma_theta, e_max, tau, used, covariance,
    *, soft, prune, fall_back,
):  # fmt: skip
    N, M, K = len(particles.yaw), len(observed.valid), len(segment_map.valid)
    counts = observed.valid[:, None] if used is None else observed.valid[:, None] & used.T
    counts = counts.astype(e_max.dtype)
    diagonal = covariance is None
    constant = jnp.diag(jnp.stack([sigma_rho, sigma_theta]) ** 2)
    covariance = jnp.broadcast_to(constant, (M, 2, 2)) if diagonal else covariance + constant
    cloud, seen, lines = prepare(particles, observed, segment_map, covariance)
    if soft:
        e_max = jnp.minimum(e_max, 1.7 * jnp.log(jnp.finfo(e_max.dtype).max))
    few = N * M * K == 0 or (fall_back and prune and N * M * K <= FEW_PAIRS)

    if soft and few:
        u = soft_weight(*_side_by_side(cloud, seen, lines), e_max, tau).sum(axis=0)
        return (counts * (jnp.log1p(u) - 0.5 * e_max)).sum(axis=0), True
    if soft:
        return soft_rows(diagonal, prune, cloud, seen, lines, e_max, tau, counts), True
    if few:
        e = _every_error(*_side_by_side(cloud, seen, lines)).min(axis=0, initial=jnp.inf)
        return -0.5 * (counts * jnp.minimum(e, e_max)).sum(axis=0), True
    cloud, seen, lines = lax.stop_gradient((cloud, seen, lines))
    exact = is_exact(seen, e_max)
    near = reach(cloud, seen, lines, e_max, jnp.zeros_like(e_max), prune, diagonal)
    values = hard(cloud, seen, near, e_max, counts, diagonal)
    if fall_back:
        values = jnp.where(exact, values, _pair_by_pair(cloud, seen, lines, e_max, counts, ~exact))
    return values, exact


def _side_by_side(cloud, seen, lines):
    """Leading axes so that all pairs broadcast to [K, M, N]."""
    seen = jax.tree.map(lambda leaf: leaf[:, None], seen)
    lines = jax.tree.map(lambda leaf: leaf[:, None, None], lines)
    return cloud, seen, lines


def _every_error(cloud, seen, lines):
    z_rho, z_theta, past, before = compare_pairs(cloud, seen, lines)
    overlap = (past < 0) & (before < 0) & seen.matchable & lines.matchable
    return jnp.where(overlap, z_rho**2 + z_theta**2, jnp.inf)


def _pair_by_pair(cloud, seen, lines, e_max, counts, needed):
    """Slow and right for any noise; no loop at all unless it is needed."""
    take = lambda tree, i: jax.tree.map(lambda leaf: leaf[i], tree)

    def over_map(m):
        error = lambda k: _every_error(cloud, take(seen, m), take(lines, k))
        nearest = lambda k, best: jnp.minimum(best, error(k))
        return lax.fori_loop(0, len(lines.rho), nearest, jnp.full_like(cloud.x, e_max))

    add = lambda m, total: total - 0.5 * counts[m] * over_map(m)
    return lax.fori_loop(0, jnp.where(needed, len(seen.rho), 0), add, jnp.zeros_like(cloud.x))
