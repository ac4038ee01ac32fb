"""What is carried from one image to the next, and what a step reports."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sofjax.extraction.sof import View
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.likelihood.measurements import measure
from sofjax.motion import OdometerBias, prior_bias
from sofjax.particles import Particles
from sofjax.segment_map import SegmentMap, empty_map
from sofjax.slam.config import Setup
from sofjax.slam.keyframes import Window, empty_window

FIRST_WAIT = 50.0  # images that must agree before they are used again; then twice as many


class Consistency(eqx.Module):
    """Whether the images showed, of late, the motion that the wheels read."""

    counts: Float[Array, "4"]  # segments: all, moving as read, by chance, and standing still
    trusted: Bool[Array, ""]  # the images are used
    wait: Float[Array, ""]  # images that must agree until they are; ...
    next_wait: Float[Array, ""]  # ... after the next time that they are given up
    T_odometer: SE2  # the odometer's readings alone, from the start
    T_world_robot: SE2  # by the odometer since the images last confirmed a turn, ...
    bias: Float[Array, "4"]  # ... with its errors as they were learned until then


class SlamState(eqx.Module):
    """What is carried from one image to the next."""

    particles: Particles
    segment_map: SegmentMap
    recent: View  # the last two views kept, a baseline apart
    reference: View
    variance_inflation: Float[Array, ""]  # of the measurements, against the sensor model; >= 1
    odometer_inflation: Float[Array, "2"]  # of the variance of distances and of turns; >= 1
    consistency: Consistency
    unmatched: Int[Array, ""]  # images in a row without one known segment
    key: PRNGKeyArray
    window: Window | None  # with a fixed lag


class StepInfo(eqx.Module):
    """What one step reports and does not carry."""

    T_world_robot: SE2  # the estimate
    covariance: Float[Array, "*batch 3 3"]  # of the particles' (x, y, yaw): in the map, not of it
    bias: Float[Array, "*batch 4"]  # the odometer's systematic errors
    effective_size: Float[Array, "*batch"]
    log_evidence: Float[Array, "*batch"]  # log of the mean likelihood of the particles, weighted
    jitter: Float[Array, "*batch 2"]  # attitude jitter (pitch, roll) of the image, radians
    misfit: Float[Array, "*batch"]  # mean error e of the matched segments; 2 if sigmas are true
    sensor_inflation: Float[Array, "*batch"]  # of the pixels' variance after the image; >= 1
    odometer_inflation: Float[Array, "*batch 2"]  # of that of distances and of turns; >= 1
    trusted: Bool[Array, "*batch"]  # the images showed the motion that the wheels read
    detected: Int[Array, "*batch"]
    below_horizon: Int[Array, "*batch"]  # on the floor's side of the horizon and within range
    associated: Int[Array, "*batch"]  # of them, by eq. (9)
    reobserved: Int[Array, "*batch"]  # of those, segments of lines that the map knows
    matched: Int[Array, "*batch"]  # to the map, by eq. (9) or not
    across: Int[Array, "*batch"]  # of them, transverse to the heading: they observe the distance
    initialised: Int[Array, "*batch"]  # lines that are new in the map
    map_overflow: Int[Array, "*batch"]  # found no free slot
    map_truncated: Int[Array, "*batch"]  # lines in view beyond the L that are compared
    lost: Bool[Array, "*batch"]
    segment_class: Int[Array, "*batch M"]  # 0 none, 1 above the horizon, 2 not floor, 3 floor


def no_consistency() -> Consistency:
    """Before the first image, and where it is not asked: `FilterConfig.doubts`."""
    none, still = jnp.zeros(()), SE2.identity()
    return Consistency(
        jnp.zeros(4), jnp.zeros((), bool), none, jnp.full((), FIRST_WAIT), still, still,
        jnp.zeros(4),
    )  # fmt: skip


def initial_state(setup: Setup, key: PRNGKeyArray, capacity: int) -> SlamState:
    """The state before the first image, all particles at the origin of the world.

    **Arguments:**
    - `key`: a typed key, `jax.random.key(0)`.
    - `capacity`: M, the number of segments that an observation has room for.
    """
    kind = getattr(key, "dtype", None)
    if kind is None or not jnp.issubdtype(kind, jax.dtypes.prng_key):
        raise ValueError(f"key must be a jax.random.key(...), not a {type(key).__name__}")
    config = setup.config
    N = config.filter.particles
    bias = prior_bias(config.motion)
    particles = Particles(
        SE2(jnp.zeros((N, 2)), jnp.zeros(N)),
        OdometerBias(jnp.broadcast_to(bias.mean, (N, 4)), bias.covariance),
        jnp.full(N, -jnp.log(N), float),
    )
    still = SE2.identity()
    none = View(Segments(jnp.zeros((capacity, 2, 2)), jnp.zeros(capacity, bool)), still, still)
    window = None
    if config.window.keyframes:
        nothing = measure(
            config.sensor, setup.camera, setup.mount, none.segments_image, config.filter.max_depth
        )
        window = empty_window(config.window, config.segment_map.capacity, nothing)
    return SlamState(
        particles, empty_map(config.segment_map), none, none, jnp.ones(()), jnp.ones(2),
        no_consistency(), jnp.zeros((), int), key, window,
    )  # fmt: skip


def shard(state: SlamState, mesh: jax.sharding.Mesh) -> SlamState:
    """The state with its particles divided among the devices of a mesh, and the rest on each.

    `SofSlam.step` and `run` then compute where their particles are, on one device or on those of
    several processes (`jax.distributed`), which begin with the same state. N must be a multiple
    of the number of devices, or a ValueError says so.
    """
    N = state.particles.log_weight.shape[0]
    if N % mesh.size:
        raise ValueError(f"{N} particles cannot be shared alike by {mesh.size} devices")
    shared = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(mesh.axis_names))
    copied = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
    where = lambda p: (p.T_world_robot.xy, p.T_world_robot.yaw, p.bias.mean, p.log_weight)
    places = jax.tree.map(lambda _: copied, state)
    places = eqx.tree_at(lambda s: where(s.particles), places, (shared,) * 4)
    return jax.jit(lambda state: state, out_shardings=places)(state)
