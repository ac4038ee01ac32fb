"""Observations without an image: the edges of a world as a detector would report them.

Pure functions of one image, mapped over the images of a drive and, by `jax.vmap`, over drives.
What hides an edge are the walls in the plan, exactly, by the shadow that each wall throws from
the camera; boxes hide nothing. Of an edge that is seen in several parts, one part is reported.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sofjax.extraction.observation import Observation
from sofjax.geometry.camera import Camera, Mount, projection_matrix
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.simulation.segments.detection import (
    LSD,
    Detection,
    both_edges,
    breadth_in_image,
    break_up,
    disturb,
    invent,
    seen_until,
)
from sofjax.simulation.segments.visibility import in_picture, length_in_image, project, unhidden
from sofjax.simulation.world.types import NARROW, World

CANDIDATES = 96  # the longest edges of an image, for which occlusion is computed


class Scene(eqx.Module):
    """The edges and walls of a world, padded so that worlds can be stacked."""

    edges_world: Float[Array, "*batch edges 2 3"]  # metres; floor, off-floor and mirrored edges
    contrast: Float[Array, "*batch edges"]  # step of brightness, 0 to 1; padding has 0
    on_floor: Bool[Array, "*batch edges"]
    width: Float[Array, "*batch edges"]  # metres, of a line that is seen as two edges; others 0
    walls_world: Float[Array, "*batch walls 2 2"]  # metres; padding has no length

    @staticmethod
    def of(world: World, edges: int | None = None, walls: int | None = None) -> "Scene":
        """The scene of a world, padded to `edges` and `walls`, or by default a little.

        **Raises:** `ValueError` if the world has more than that.
        """
        kinds = (world.floor_segments, world.off_floor_segments, world.reflections)
        endpoints = np.concatenate([kind.endpoints for kind in kinds])
        contrast = np.concatenate([kind.contrast for kind in kinds])
        on_floor = np.arange(len(contrast)) < len(kinds[0].contrast)
        width = np.zeros(len(contrast))
        narrow = [kind in NARROW for parts in kinds for kind in parts.kinds]
        width[narrow] = world.floor_lines.widths
        edges = edges or -(-len(contrast) // 64) * 64
        walls = walls or -(-len(world.walls) // 8) * 8
        return Scene(
            jnp.asarray(_pad(endpoints, edges, "edges"), float),
            jnp.asarray(_pad(contrast, edges, "edges"), float),
            jnp.asarray(_pad(on_floor, edges, "edges")),
            jnp.asarray(_pad(width, edges, "edges"), float),
            jnp.asarray(_pad(world.walls, walls, "walls"), float),
        )


def _pad(rows: np.ndarray, length: int, what: str) -> np.ndarray:
    if len(rows) > length:
        raise ValueError(f"the world has {len(rows)} {what} and the capacity is {length}")
    return np.concatenate([rows, np.zeros((length - len(rows), *rows.shape[1:]), rows.dtype)])


def observe(
    scene: Scene,
    camera: Camera,
    mount: Mount,
    T_world_robot: SE2,
    motion: SE2,
    key: PRNGKeyArray,
    detection: Detection = LSD,
    capacity: int = 64,
) -> Observation:
    """What the filter takes, directly from a world; under `jax.jit`, and `jax.vmap` over drives.

    **Arguments:**
    - `mount`, `T_world_robot`, `motion`: with one axis T in front: the mount as it shook at each
      image, true poses, and the odometer's readings.

    **Returns:** an observation with a leading T and `capacity` segments an image, the
    longest if there are more.
    """

    def image(each: tuple[Mount, SE2, PRNGKeyArray]) -> tuple[Segments, Int[Array, ""]]:
        mount, T_world_robot, key = each
        return see(scene, camera, mount, T_world_robot, key, detection, capacity)

    keys = jax.random.split(key, motion.yaw.shape[0])
    segments_image, overflow = jax.lax.map(image, (mount, T_world_robot, keys))
    return Observation(segments_image, motion, overflow)


def see(
    scene: Scene,
    camera: Camera,
    mount: Mount,
    T_world_robot: SE2,
    key: PRNGKeyArray,
    detection: Detection,
    capacity: int,
) -> tuple[Segments, Int[Array, ""]]:
    """The segments of one image, and how many more there were than `capacity`."""
    P = projection_matrix(camera, mount, T_world_robot)
    C = T_world_robot.apply(mount.T_robot_nadir.xy)
    homogeneous = jnp.pad(scene.edges_world, ((0, 0), (0, 0), (0, 1)), constant_values=1.0) @ P.T

    # Inside the picture, and of some length there; fine lines no farther than they can be seen
    breadth = jax.vmap(breadth_in_image, in_axes=(0, 0, 0, None))(
        homogeneous, scene.edges_world, scene.width, P
    )
    depth_seen = seen_until(breadth, scene.contrast, detection.min_contrast, detection)
    part = jax.vmap(in_picture, in_axes=(0, None, 0))(homogeneous, camera, depth_seen)
    length = jax.vmap(length_in_image)(homogeneous, part)
    candidates = min(CANDIDATES, len(scene.contrast))
    length, chosen = jax.lax.top_k(jnp.where(scene.contrast > 0, length, 0), candidates)
    homogeneous, part, breadth = homogeneous[chosen], part[chosen], breadth[chosen]
    plan = scene.edges_world[chosen, :, :2] - C[None, None]

    # Not behind a wall
    part = jax.vmap(unhidden, in_axes=(0, 0, None))(plan, part, scene.walls_world - C[None, None])
    segments = jax.vmap(project)(homogeneous, part)

    # As a detector reports them, with a separate draw for each of the two edges of a fine line
    miss_key, break_key, false_key, noise_key = jax.random.split(key, 4)
    seldom = jax.random.uniform(miss_key, (candidates, 2)) / (1 - detection.missed)
    wanted = detection.min_contrast + seldom * (detection.full_contrast - detection.min_contrast)
    wanted = jnp.where(seldom < 1, wanted, jnp.inf)
    depth_seen = seen_until(breadth[:, None], scene.contrast[chosen, None], wanted, detection)
    pieces, whole = jax.vmap(break_up, in_axes=(0, 0, None))(
        segments, jax.random.uniform(break_key, (candidates, 3)), detection.broken
    )
    whole &= ((part[:, 1] > part[:, 0]) & (depth_seen[:, 0] > 0))[:, None]
    edges, seen = jax.vmap(both_edges, in_axes=(0, 0, 0, 0, None))(
        homogeneous, part, breadth, depth_seen, detection.blur
    )
    fine = breadth > 0
    pieces = jnp.where(fine[:, None, None, None], edges, pieces)
    whole = jnp.where(fine[:, None], seen, whole)
    invented, there = invent(camera, detection, false_key)
    endpoints = jnp.concatenate([pieces.reshape(-1, 2, 2), invented])
    valid = jnp.concatenate([whole.reshape(-1), there])
    draws = jax.random.normal(noise_key, (len(endpoints), 2, 2))
    endpoints = jax.vmap(disturb, in_axes=(0, 0, None))(endpoints, draws, detection)
    valid &= Segments(endpoints, valid).length >= detection.shortest
    longest, order = jax.lax.top_k(jnp.where(valid, Segments(endpoints, valid).length, 0), capacity)
    found = longest > 0
    packed = jnp.where(found[:, None, None], endpoints[order], 0)
    return Segments(packed, found), jnp.maximum(jnp.sum(valid) - capacity, 0)
