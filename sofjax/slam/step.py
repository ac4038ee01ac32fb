"""SoF-SLAM; Fig. 6 of the paper as one pure, jitted step."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sofjax._pytree import half_if_enough, in_any_run
from sofjax.extraction.association import Association, gate_probability
from sofjax.extraction.observation import Observation
from sofjax.extraction.sof import SofExtraction, View, extract, keep_views, view_a_baseline_away
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.likelihood.measurements import SensorModel, measure, unobservable_direction
from sofjax.likelihood.tracking import (
    adapt_noise,
    compare,
    log_density,
    nothing_seen,
    pair,
    pixels_and_weight,
)
from sofjax.motion import (
    MotionModel,
    OdometerBias,
    prior_bias,
    read_or_unknown,
    sample_motion,
    sample_slip,
    sample_unknown,
)
from sofjax.particles import (
    Particles,
    effective_size,
    mean_pose,
    pose_covariance,
    resample_observable,
    systematic,
    winner,
)
from sofjax.segment_map import (
    MapConfig,
    SegmentMap,
    candidate_associations,
    empty_map,
    in_view,
    integrate,
    nearby,
)
from sofjax.slam.fixed_lag import FixedLagConfig, Window, empty_window, slide

SURE = 1.5  # noise up to which the sensor may convict the wheels of a slip
LOST_AFTER = 10  # images without one known segment
ACROSS = 0.5  # sine of the angle from the heading beyond which a line runs across the way
MARGIN = 1.0  # metres by which a map line may be off and still be compared
KNOWN = 0.5  # prior probability that a segment on the floor is one of the map; of the soft form


class FilterConfig(eqx.Module):
    """How many particles, and how the next generation is chosen."""

    particles: int = eqx.field(static=True, default=1000)  # N
    choice: str = eqx.field(static=True, default="resample")  # or "winner", the paper's
    effective_share: float = 0.5  # resample below this share of N
    gate_each: bool = eqx.field(
        static=True, default=False
    )  # Fig. 6, step 4: SoF for every particle
    soft: bool = eqx.field(static=True, default=False)  # densities to differentiate; see `run`
    max_depth: float = 8.0  # metres: farther segments are not used


class SlamConfig(eqx.Module):
    """Every setting of the method, beside the part that reads it."""

    association: Association = Association()
    motion: MotionModel = MotionModel()
    sensor: SensorModel = SensorModel()
    segment_map: MapConfig = MapConfig()
    filter: FilterConfig = FilterConfig()
    window: FixedLagConfig = FixedLagConfig()


class SlamState(eqx.Module):
    """What is carried from one image to the next."""

    particles: Particles
    segment_map: SegmentMap
    recent: View  # the last two views kept, a baseline apart
    reference: View
    noise: Float[Array, ""]  # variance of the measurements as multiple of the sensor model's, >= 1
    unmatched: Int[Array, ""]  # images in a row without one known segment
    key: PRNGKeyArray
    window: Window | None  # if some is smoothed while driving


class StepInfo(eqx.Module):
    """What one step tells and does not carry."""

    T_world_robot: SE2  # the estimate
    covariance: Float[Array, "*batch 3 3"]  # of the particles' (x, y, yaw): in the map, not of it
    bias: Float[Array, "*batch 4"]  # its odometer's errors
    effective_size: Float[Array, "*batch"]
    log_evidence: Float[Array, "*batch"]  # log of the mean likelihood of the particles, weighted
    tilt: Float[Array, "*batch 2"]  # jitter (pitch, roll) of the moment, radians
    misfit: Float[Array, "*batch"]  # mean error e of the matched segments; 2 if sigmas are true
    detected: Int[Array, "*batch"]
    below_horizon: Int[Array, "*batch"]  # on the floor's side of the horizon and within range
    associated: Int[Array, "*batch"]  # of them, by eq. (9)
    reobserved: Int[Array, "*batch"]  # of those, segments of lines that the map knows
    matched: Int[Array, "*batch"]  # to the map, by eq. (9) or not
    across: Int[Array, "*batch"]  # of them, those that run across the heading and hold the distance
    initialised: Int[Array, "*batch"]  # new in the map
    map_overflow: Int[Array, "*batch"]  # found no free slot
    map_truncated: Int[Array, "*batch"]  # lines within view beyond the L that are compared
    lost: Bool[Array, "*batch"]
    segment_class: Int[Array, "*batch M"]  # 0 none, 1 above the horizon, 2 not floor, 3 floor


def init(
    config: SlamConfig, camera: Camera, mount: Mount, key: PRNGKeyArray, capacity: int
) -> SlamState:
    """All particles at the origin of the world, before the first image.

    **Arguments:**
    - `capacity`: M, the number of segments that an observation has room for.
    """
    N = config.filter.particles
    bias = prior_bias(config.motion)
    particles = Particles(
        SE2(jnp.zeros((N, 2)), jnp.zeros(N)),
        OdometerBias(jnp.broadcast_to(bias.mean, (N, 4)), bias.covariance),
        jnp.full(N, -jnp.log(N), float),
    )
    none = View(Segments(jnp.zeros((capacity, 2, 2)), jnp.zeros(capacity, bool)), SE2.identity())
    window = None
    if config.window.keyframes:
        nothing = measure(
            config.sensor, camera, mount, none.segments_image, config.filter.max_depth
        )
        window = empty_window(config.window, config.segment_map.capacity, nothing)
    return SlamState(
        particles, empty_map(config.segment_map), none, none, jnp.ones(()), jnp.zeros((), int),
        key, window,
    )  # fmt: skip


def distribute(state: SlamState, mesh: jax.sharding.Mesh) -> SlamState:
    """Every device of a mesh takes its share of the particles, and a copy of all else.

    `step` and `run` then compute where their particles are, on one device or on those of several
    processes (`jax.distributed`), which begin with the same state. N must be a multiple of the
    number of devices.
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


@jax.jit
def step(
    config: SlamConfig, camera: Camera, mount: Mount, state: SlamState, observation: Observation
) -> tuple[SlamState, StepInfo]:
    """One round of Fig. 6. Pure; compiled once for all images of one capacity."""
    rules, sensor = config.segment_map, config.sensor
    N = config.filter.particles
    key, key_motion, key_slip, key_choice = jax.random.split(state.key, 4)

    # 1-3) move, and sample N particles by the motion model
    odometer, unknown = read_or_unknown(observation.motion, observation.motion_sigma)
    motion, bias = sample_motion(config.motion, state.particles.bias, odometer, key_motion)
    slip, log_ratio = sample_slip(config.motion, odometer, state.noise < SURE, key_slip, N)
    start = state.particles.T_world_robot
    start = jax.lax.cond(
        in_any_run((unknown > 0).any()),
        lambda: start @ sample_unknown(unknown, jax.random.fold_in(key_motion, 1), N),
        lambda: start,
    )
    unslipped = Particles(start @ motion, bias, state.particles.log_weight)
    T_world_robot = unslipped.T_world_robot @ slip
    prior = state.particles.log_weight + log_ratio
    moved = Particles(T_world_robot, bias, prior - jax.nn.logsumexp(prior))
    predicted = mean_pose(moved)

    # 4) put the segments on the floor, and extract SoF (Fig. 5) against a view a baseline away
    variance, weight = pixels_and_weight(sensor, state.noise)
    measurements = measure(
        sensor, camera, mount, observation.segments_image, config.filter.max_depth, variance
    )
    view = view_a_baseline_away(config.association, state.recent, state.reference, predicted)
    sof = lambda T: extract(
        config.association, camera, mount, view.segments_image, observation.segments_image,
        view.T_world_robot.between(T), config.filter.max_depth,
    )  # fmt: skip
    is_sof = sof(predicted).is_floor
    gate = lambda T: _gate(config, sof(T))
    used = jax.vmap(gate)(T_world_robot) if config.filter.gate_each else measurements.valid[None]
    used = jnp.broadcast_to(used, (N, used.shape[1]))

    # 5) compare with the map by the sensor model, and choose
    T_world_nadir = predicted @ mount.T_robot_nadir
    ends = jnp.where(measurements.valid[:, None, None], measurements.endpoints_nadir, 0)
    reach = jnp.sqrt(jnp.sum(ends**2, axis=-1).max()) + rules.join_gap + MARGIN
    near, truncated = nearby(rules, state.segment_map, T_world_nadir, reach)
    lines = state.segment_map.take(near)
    candidates, at, nearest = candidate_associations(
        rules, sensor, lines, measurements, T_world_nadir
    )
    pairs = pair(measurements, candidates)
    nadirs = T_world_nadir.inverse() @ (T_world_robot @ mount.T_robot_nadir)
    counted = lambda T: sof(T).is_floor if config.filter.gate_each else measurements.valid

    def seen_from(T):  # a `cond`, as XLA would otherwise work it out anew for whoever asks
        of_one = lambda: compare(
            sensor, pairs, T_world_nadir.between(T @ mount.T_robot_nadir), counted(T)
        )
        nothing = lambda: nothing_seen(sensor, pairs)
        return jax.lax.cond(in_any_run(measurements.valid.any()), of_one, nothing)

    if config.filter.soft:
        unused = observation.segments_image.valid & ~measurements.valid
        many = in_view(rules, camera, mount, lines, predicted).sum(), unused.sum()
        of_soft = lambda T, use: _log_density(
            config, camera, measurements, candidates, T, use, *many
        )
        log_likelihood = jax.vmap(of_soft)(nadirs, used)
    else:
        of_hard = lambda rows: compare(sensor, rows[0], nadirs, rows[1]).log_likelihood
        log_likelihood = weight * half_if_enough(of_hard, (pairs, used.T), measurements.valid)
    log_weight = moved.log_weight + log_likelihood
    log_evidence = jax.nn.logsumexp(log_weight)
    weighted = Particles(T_world_robot, bias, log_weight - log_evidence)
    size = effective_size(weighted.log_weight)
    if config.filter.choice == "winner":
        particles = weighted.take(winner(weighted.log_weight))
        chosen = mean_pose(particles)
        best = seen_from(chosen)
    else:
        offsets = jax.random.uniform(key_choice, (3,))
        chosen = mean_pose(weighted)
        best = seen_from(chosen)
        if not config.filter.soft:  # whose gradient needs particles that are drawn as a whole
            free, parallel = unobservable_direction(measurements, best.error < sensor.e_max)

            def across():
                of_seen = log_ratio + log_likelihood, predicted.yaw + free
                drawn = resample_observable(offsets[:2], unslipped, T_world_robot, *of_seen)
                return jax.tree.map(lambda a, b: jnp.where(parallel, a, b), drawn, weighted)

            # what is seen stays the same all along it, and so `best`
            weighted = jax.lax.cond(in_any_run(parallel), across, lambda: weighted)
            chosen = mean_pose(weighted)
        few = effective_size(weighted.log_weight) < config.filter.effective_share * N

        def resampled():
            drawn = weighted.take(systematic(offsets[2], weighted.log_weight), config.filter.soft)
            return jax.tree.map(lambda a, b: jnp.where(few, a, b), drawn, weighted)

        particles = jax.lax.cond(in_any_run(few), resampled, lambda: weighted)

    # 6) integrate the observed segments into the map, as seen from the chosen pose
    known = best.error < sensor.e_max
    new = is_sof & (nearest > sensor.e_max) & counted(chosen) & ~known & ~measurements.upright
    segment_map, overflow, new_at = integrate(
        rules, sensor, state.segment_map, near, measurements,
        jnp.take_along_axis(at, best.choice[:, None], 1)[:, 0], at,
        known, new, best.tilt,
        in_view(rules, camera, mount, lines, chosen), chosen @ mount.T_robot_nadir,
    )  # fmt: skip

    # not in the paper: the last keyframes are smoothed, and all moves with the latest
    mean_bias = jnp.exp(weighted.log_weight) @ weighted.bias.mean
    window = state.window
    if window is not None:
        posterior_given_class = OdometerBias(mean_bias, bias.covariance)
        window, segment_map, T_new_old = slide(
            config.window, rules, sensor, config.motion, window, segment_map,
            mount.T_robot_nadir, odometer, chosen, best.tilt, posterior_given_class, measurements,
            new_at, config.filter.max_depth, unknown,
        )  # fmt: skip
        chosen = T_new_old @ chosen
        particles = eqx.tree_at(
            lambda p: p.T_world_robot, particles, T_new_old @ particles.T_world_robot
        )

    # 7) the next round starts from here
    recent, reference = keep_views(
        config.association, state.recent, state.reference, View(observation.segments_image, chosen)
    )
    misfit = jnp.where(known, best.error, 0).sum() / jnp.maximum(known.sum(), 1).astype(float)
    noise = jnp.where(known.any(), adapt_noise(sensor, state.noise, misfit), state.noise)
    unmatched = jnp.where(known.any(), 0, state.unmatched + 1)
    detected = observation.segments_image.valid
    info = StepInfo(
        T_world_robot=chosen,
        covariance=pose_covariance(weighted),
        bias=mean_bias,
        effective_size=size,
        log_evidence=log_evidence,
        tilt=best.tilt,
        misfit=misfit,
        detected=detected.sum(),
        below_horizon=measurements.valid.sum(),
        associated=is_sof.sum(),
        reobserved=(is_sof & known).sum(),
        matched=known.sum(),
        across=(known & (jnp.abs(jnp.sin(measurements.line.theta)) > ACROSS)).sum(),
        initialised=new.sum() - overflow,
        map_overflow=overflow,
        map_truncated=truncated,
        lost=unmatched >= LOST_AFTER,
        segment_class=sum(
            stage.astype(int)
            for stage in (detected, measurements.valid, measurements.valid & (known | new))
        ),
    )
    return SlamState(particles, segment_map, recent, reference, noise, unmatched, key, window), info


@jax.jit
def run(
    config: SlamConfig, camera: Camera, mount: Mount, state: SlamState, observations: Observation
) -> tuple[SlamState, StepInfo]:
    """A whole log as one scan: the same as `step` for one image after the other.

    With `config.filter.soft` the sum of `info.log_evidence` is the log-evidence of the drive, a
    density whose constants are all there, with derivatives by the settings of motion and sensor,
    by the mount, and with `gate_each` by alpha, beta, Theta and its temperature in eq. (9). Going
    back keeps one state a step and works the rest out again.

    Which derivatives are right: with the random numbers fixed, and as long as none is resampled,
    it is that of the function to the last digit. What resampling owes to the weights is credited
    (`Particles.take`), so that for a given map the derivative of the evidence is unbiased and that
    of its logarithm off by 1/N, at the price of noise: use the mean of several keys. Biased by
    what it leaves out is how the map's decisions depend on the settings (what is born, known,
    merged, off-floor or forgotten; when the noise adapts) and the paper's choice "winner".
    By `e_max`, and by whatever else only decides, it is zero.

    **Arguments:**
    - `observations`: leaves with a leading axis T.

    **Returns:** the last state, and the infos with a leading axis T.
    """
    one = lambda state, observation: step(config, camera, mount, state, observation)
    one = jax.checkpoint(one, prevent_cse=False)  # True gave wrong gradients under jit
    return jax.lax.scan(one, state, observations)


def _gate(config: SlamConfig, found: SofExtraction) -> Array:
    """Which segments are on the floor, or if soft, how probably."""
    if not config.filter.soft:
        return found.is_floor
    return jnp.where(
        found.segments_robot.valid, gate_probability(config.association, found.matches.error), 0
    )


def _log_density(config, camera, measurements, candidates, T_predicted_nadir, floor, lines, unused):
    """Of one pose, by the probabilities [M] of lying on the floor and the lines in view.

    What is not used (above the horizon, too far, of an uncertain direction) counts as anywhere in
    the image: how many those are depends on sigmas and mount; a density is of all that was seen.
    """
    elsewhere = -jnp.log(float(camera.width * camera.height))  # its ends anywhere in the image
    lines = jnp.maximum(lines, 1).astype(float)
    known = KNOWN * floor
    of_used = log_density(
        config.sensor, measurements, candidates, T_predicted_nadir, known, lines, elsewhere
    )
    return of_used + unused.astype(float) * elsewhere
