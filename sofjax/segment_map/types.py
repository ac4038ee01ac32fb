"""The map's lines: what is kept of each, whether it lies on the floor, and how it should appear."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax._pytree import in_any_run
from sofjax.geometry.angles import safe_sqrt
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.floor import floor_homography, floor_to_image
from sofjax.geometry.lines import PolarLine
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments


class MapConfig(eqx.Module):
    """How the map grows; the paper's R and L, and what goes past it."""

    rule: str = eqx.field(static=True, default="kalman")  # or "gamma", eq. (14)
    classify: bool = eqx.field(
        static=True, default=True
    )  # estimate the apparent scale, tell floor from above
    directed: bool = eqx.field(static=True, default=False)  # tell a line's edges apart
    capacity: int = eqx.field(static=True, default=1024)  # K
    nearby: int = eqx.field(static=True, default=256)  # L, map lines that an image may show
    candidates: int = eqx.field(static=True, default=4)  # C, map lines compared per measurement
    range: float = 5.0  # R, metres: what is farther does not extend a segment
    length: float = 10.0  # L = 2 R, metres: a longer segment rests
    rest: int = 10  # steps
    merge_distance: float = 0.01  # metres between doubled lines
    merge_angle: float = 0.035  # radians
    join_gap: float = 0.3  # metres between two pieces of one line
    scale_sigma: float = 0.3  # prior of a line that does not lie on the floor
    scale_above: float = 1.04  # a magnification between these two is taken for floor: nothing ...
    scale_below: float = 0.7  # ... lies little under a floor, and reflections lie deep
    scale_gate: float = 3.0  # standard deviations from 1 that tell a line from the floor
    scale_known: float = 0.07  # standard deviation below which a line may be one of the final map
    rho_drift: float = 0.002  # metres: no map line is known better than ...
    theta_drift: float = 0.002  # ... this, radians
    recall: int = 1_000_000  # steps unseen after which a line is not looked for any more
    forget: int = 50  # steps unseen after which a line of few measurements is dropped
    min_updates: int = 5  # measurements that make a line one of the final map, ...
    min_share: float = 0.25  # ... and their share of the images in which it should have been seen


class SegmentMap(eqx.Module):
    """K slots for map segments."""

    segments_world: Segments  # [K], metres
    anchor: SE2  # [K] T_world_nadir of the first measurement
    line: Float[Array, "K 3"]  # (rho, theta, apparent scale) in the anchor
    covariance: Float[Array, "K 3 3"]
    updates: Int[Array, "K"]  # delta of eq. (14)
    resting: Int[Array, "K"]  # steps left
    unseen: Int[Array, "K"]  # steps since the last measurement
    expected: Int[Array, "K"]  # images in which its middle was in view

    @property
    def valid(self) -> Bool[Array, "K"]:
        return self.segments_world.valid

    def take(self, slots: Int[Array, "L"]) -> "SegmentMap":
        """A map of these slots; K stands for none."""
        there = slots < self.updates.shape[0]
        some = jax.tree.map(lambda a: a.at[slots].get(mode="clip"), self)
        return eqx.tree_at(lambda m: m.segments_world.valid, some, some.valid & there)

    def put(self, slots: Int[Array, "L"], some: "SegmentMap") -> "SegmentMap":
        """The map with `some` back in the slots that they were taken from."""
        return jax.tree.map(lambda a, b: a.at[slots].set(b, mode="drop"), self, some)


def empty_map(rules: MapConfig) -> SegmentMap:
    K = rules.capacity
    return SegmentMap(
        segments_world=Segments(jnp.zeros((K, 2, 2)), jnp.zeros(K, bool)),
        anchor=SE2(jnp.zeros((K, 2)), jnp.zeros(K)),
        line=jnp.zeros((K, 3)).at[:, 2].set(1),
        covariance=jnp.broadcast_to(jnp.eye(3), (K, 3, 3)),
        updates=jnp.zeros(K, int),
        resting=jnp.zeros(K, int),
        unseen=jnp.zeros(K, int),
        expected=jnp.zeros(K, int),
    )


def is_off_floor(
    rules: MapConfig, line: Float[Array, "*lines 3"], covariance: Float[Array, "*lines 3 3"]
) -> Bool[Array, "*lines"]:
    """Whether all views of a line together say that it does not lie on the floor."""
    apparent_scale, sigma = line[..., 2], safe_sqrt(covariance[..., 2, 2])
    outside = (apparent_scale > rules.scale_above) | (apparent_scale < rules.scale_below)
    return rules.classify & outside & (jnp.abs(apparent_scale - 1) > rules.scale_gate * sigma)


def on_floor(line: Float[Array, "3"], covariance: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The line if it lies on the floor: conditioned on an apparent scale of 1."""
    gain = covariance[:, 2] / covariance[2, 2]
    return (line + gain * (1 - line[2])).at[2].set(1)


def posterior_given_class(
    rules: MapConfig, line: Float[Array, "3"], covariance: Float[Array, "3 3"]
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """A line's estimate given its class: of a floor line, conditioned on an apparent scale of 1."""
    gain = covariance[:, 2] / covariance[2, 2]
    certain = covariance - jnp.outer(gain, covariance[2])
    off_floor = is_off_floor(rules, line, covariance)
    return (
        jnp.where(off_floor, line, on_floor(line, covariance)),
        jnp.where(off_floor, covariance, certain),
    )


def predict_measurement(
    line: Float[Array, "3"], anchor: SE2, T_world_nadir: SE2
) -> tuple[Float[Array, "3"], Float[Array, "2 3"]]:
    """How a map line should appear from a nadir.

    **Returns:** (rho, theta, apparent scale) about that nadir, and d(rho, theta) / d(line).
    """
    T_anchor_nadir = anchor.between(T_world_nadir)
    polar = PolarLine(line[0], line[1])
    x, y = T_anchor_nadir.xy
    c, s = jnp.cos(polar.theta), jnp.sin(polar.theta)
    along, across = c * x + s * y, c * y - s * x
    rho = line[0] - line[2] * across
    zero, one = jnp.zeros_like(rho), jnp.ones_like(rho)
    H = jnp.stack([jnp.stack([one, line[2] * along, -across]), jnp.stack([zero, one, zero])])
    return jnp.stack([rho, line[1] - T_anchor_nadir.yaw, line[2]]), H


RUNGS = 16  # radii to choose from where there are more lines than an image may show


def nearby(
    rules: MapConfig,
    segment_map: SegmentMap,
    T_world_nadir: SE2,
    reach: Float[Array, ""] | float,
    most: int | None = None,
) -> tuple[Int[Array, "L"], Int[Array, ""]]:
    """The slots of the lines nearest to a nadir: the one pass over the whole map in a step.

    All lines if there are no more than L; else those within a radius of which there are so many,
    which leaves nothing out that can be seen as long as it is not less than `reach`. Those unseen
    for longer than `rules.recall` are passed over.

    **Arguments:**
    - `reach`: metres that the farthest point seen, and what may match it, is away.
    - `most`: L, if not that of the rules.

    **Returns:** the slots in ascending order, K for none; and how many lines within `reach` are
    not among them.
    """
    K = segment_map.updates.shape[0]
    L = min(most or rules.nearby, K)
    there = segment_map.valid & (segment_map.unseen <= rules.recall)

    def nearest():
        ends = segment_map.segments_world.endpoints - T_world_nadir.xy
        x, y = ends[:, 0, 0], ends[:, 0, 1]
        u, v = ends[:, 1, 0] - x, ends[:, 1, 1] - y
        share = jnp.clip(-(x * u + y * v) / jnp.maximum(u * u + v * v, 1e-12), 0, 1)
        # an off-floor line is seen magnified about the nadir
        distance2 = ((x + share * u) ** 2 + (y + share * v) ** 2) * segment_map.line[:, 2] ** 2
        distance2 = jnp.where(there, distance2, jnp.inf)
        radii = jnp.append(reach * jnp.arange(1, RUNGS + 1, dtype=float) / RUNGS, jnp.inf)
        counts = jnp.sum(distance2 < radii[:, None] ** 2, axis=1)
        near = distance2 < jnp.max(jnp.where(counts <= L, radii, 0)) ** 2
        return near, counts[RUNGS - 1] - jnp.minimum(near.sum(), counts[RUNGS - 1])

    everything = lambda: (there, jnp.zeros((), int))
    near, truncated = jax.lax.cond(in_any_run(there.sum() > L), nearest, everything)
    place = jnp.where(near, jnp.cumsum(near) - 1, L)
    slots = jnp.full(L, K).at[place].set(jnp.arange(K), mode="drop")
    return slots, truncated


def in_view(
    rules: MapConfig, camera: Camera, mount: Mount, segment_map: SegmentMap, T_world_robot: SE2
) -> Bool[Array, "K"]:
    """Which map lines have their middle in the image and within R; walls do not hide them."""
    H_F = floor_homography(camera, mount, T_world_robot)
    nadir = T_world_robot.apply(mount.T_robot_nadir.xy)
    middle = segment_map.segments_world.endpoints.mean(axis=1) - nadir
    apparent = nadir + middle * segment_map.line[:, 2:]
    x, ahead = jax.vmap(floor_to_image, in_axes=(None, 0))(H_F, apparent)
    inside = (x >= 0).all(axis=1) & (x < jnp.array([camera.width, camera.height], float)).all(
        axis=1
    )
    return segment_map.valid & ahead & inside & (jnp.sum(middle**2, axis=1) < rules.range**2)
