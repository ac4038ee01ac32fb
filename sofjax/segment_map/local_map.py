"""The part of the map that an image may show, and how its lines appear from there."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax._pytree import in_any_run
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.floor import floor_homography, floor_to_image
from sofjax.geometry.lines import PolarLine
from sofjax.geometry.se2 import SE2
from sofjax.segment_map.types import MapConfig, SegmentMap


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
    config: MapConfig,
    segment_map: SegmentMap,
    T_world_nadir: SE2,
    reach: Float[Array, ""] | float,
    most: int | None = None,
) -> tuple[Int[Array, "L"], Int[Array, ""]]:
    """The slots of the lines nearest to a nadir: the one pass over the whole map in a step.

    All lines if there are no more than L; else those within a radius of which there are so many,
    which leaves nothing out that can be seen as long as it is not less than `reach`. Those unseen
    for longer than `config.recall` are passed over.

    **Arguments:**
    - `reach`: metres that the farthest point seen, and what may match it, is away.
    - `most`: L, if not that of the config.

    **Returns:** the slots in ascending order, K for none; and how many lines within `reach` are
    not among them.
    """
    K = segment_map.updates.shape[0]
    L = min(most or config.nearby, K)
    there = segment_map.valid & (segment_map.unseen <= config.recall)

    def nearest() -> tuple[Bool[Array, "K"], Int[Array, ""]]:
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
    config: MapConfig, camera: Camera, mount: Mount, segment_map: SegmentMap, T_world_robot: SE2
) -> Bool[Array, "K"]:
    """Which map lines have their middle in the image and within R; walls do not hide them."""
    ends, scale = segment_map.segments_world.endpoints, segment_map.line[:, 2:]
    seen = middles_in_view(config, camera, mount, ends, scale, T_world_robot)
    return segment_map.valid & seen


def middles_in_view(
    config: MapConfig,
    camera: Camera,
    mount: Mount,
    endpoints_world: Float[Array, "K 2 2"],
    apparent_scale: Float[Array, "K 1"],
    T_world_robot: SE2,
) -> Bool[Array, "K"]:
    """Which segments have their middle in the image and within R of the camera's nadir."""
    H_F = floor_homography(camera, mount, T_world_robot)
    nadir = T_world_robot.apply(mount.T_robot_nadir.xy)
    middle = endpoints_world.mean(axis=1) - nadir
    apparent = nadir + middle * apparent_scale
    x, ahead = jax.vmap(floor_to_image, in_axes=(None, 0))(H_F, apparent)
    size = jnp.array([camera.width, camera.height], float)
    inside = (x >= 0).all(axis=1) & (x < size).all(axis=1)
    return ahead & inside & (jnp.sum(middle**2, axis=1) < config.range**2)
