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

from sofjax.geometry.angles import safe_divide, safe_norm
from sofjax.geometry.camera import Camera, Mount, projection_matrix
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.observation import Observation
from sofjax.simulation.worlds import NARROW, World

NEAREST_DEPTH = 0.1  # metres before the camera
WALL_DEPTH = 0.05  # metres behind a wall's face that it does not hide: what is fixed to it
CANDIDATES = 96  # edges of an image, the longest, whose hiding is worked out
FALSE_SLOTS = 8  # false segments of an image at most
ANCHORS = (0.5, 0.2, 0.8, 0.05, 0.95)  # shares of an edge from which its seen part is grown


class Scene(eqx.Module):
    """The edges and walls of a world, padded so that worlds can be stacked."""

    edges_world: Float[Array, "*batch edges 2 3"]  # metres; floor, raised and mirrored edges
    contrast: Float[Array, "*batch edges"]  # step of brightness, 0 to 1; padding has 0
    on_floor: Bool[Array, "*batch edges"]
    narrow: Bool[Array, "*batch edges"]  # a line of some millimetres, seen as two edges
    walls_world: Float[Array, "*batch walls 2 2"]  # metres; padding has no length

    @staticmethod
    def of(world: World, edges: int | None = None, walls: int | None = None) -> "Scene":
        """The scene of a world, padded to `edges` and `walls`, or by default a little.

        **Raises:** `ValueError` if the world has more than that.
        """
        kinds = (world.floor_segments, world.raised_segments, world.reflections)
        endpoints = np.concatenate([kind.endpoints for kind in kinds])
        contrast = np.concatenate([kind.contrast for kind in kinds])
        on_floor = np.arange(len(contrast)) < len(kinds[0].contrast)
        narrow = np.array([kind in NARROW for parts in kinds for kind in parts.kinds])
        edges = edges or -(-len(contrast) // 64) * 64
        walls = walls or -(-len(world.walls) // 8) * 8
        return Scene(
            jnp.asarray(_pad(endpoints, edges, "edges"), float),
            jnp.asarray(_pad(contrast, edges, "edges"), float),
            jnp.asarray(_pad(on_floor, edges, "edges")),
            jnp.asarray(_pad(narrow, edges, "edges")),
            jnp.asarray(_pad(world.walls, walls, "walls"), float),
        )


def _pad(rows: np.ndarray, length: int, what: str) -> np.ndarray:
    if len(rows) > length:
        raise ValueError(f"the world has {len(rows)} {what} where there is room for {length}")
    return np.concatenate([rows, np.zeros((length - len(rows), *rows.shape[1:]), rows.dtype)])


class Detection(eqx.Module):
    """How a line detector errs; the defaults are those of LSD on 320×240 pixels."""

    noise: float = 0.25  # pixels, standard deviation of an end across the line
    shortening: float = 1.5  # pixels that an end is short of the edge's, mean size
    missed: float = 0.1  # share of edges of good contrast that are not seen
    full_contrast: float = 0.1  # step of brightness from which an edge's contrast is good
    fading: float = 0.3  # share of a narrow line's contrast that the blur leaves
    apart: float = 2.4  # pixels between the two edges that are seen of a narrow line
    broken: float = 0.25  # share of edges that come in two pieces
    false_segments: float = 2.0  # mean number an image
    shortest: float = 15.0  # pixels
    max_depth: float = 10.0  # metres


LSD = Detection()


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
    """What the filter takes, straight from a world; under `jax.jit`, and `jax.vmap` over drives.

    **Arguments:**
    - `mount`, `T_world_robot`, `motion`: with one axis T in front: the mount as it shook at each
      image, true poses, and the odometer's readings.

    **Returns:** an observation with a leading T and room for `capacity` segments an image, the
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
    C = T_world_robot.apply(mount.T_robot_foot.xy)
    homogeneous = jnp.pad(scene.edges_world, ((0, 0), (0, 0), (0, 1)), constant_values=1.0) @ P.T

    # Inside the picture, and of some length there
    part = jax.vmap(in_picture, in_axes=(0, None, None))(homogeneous, camera, detection.max_depth)
    length = jax.vmap(length_in_image)(homogeneous, part)
    candidates = min(CANDIDATES, len(scene.contrast))
    length, chosen = jax.lax.top_k(jnp.where(scene.contrast > 0, length, 0), candidates)
    homogeneous, part = homogeneous[chosen], part[chosen]
    plan = scene.edges_world[chosen, :, :2] - C[None, None]

    # Not behind a wall
    part = jax.vmap(unhidden, in_axes=(0, 0, None))(plan, part, scene.walls_world - C[None, None])
    segments = jax.vmap(project)(homogeneous, part)

    # As a detector reports them
    miss_key, break_key, false_key, noise_key = jax.random.split(key, 4)
    narrow = scene.narrow[chosen]
    contrast = scene.contrast[chosen] * jnp.where(narrow, detection.fading, 1)
    clear = jnp.minimum(contrast / detection.full_contrast, 1)
    detected = jax.random.uniform(miss_key, clear.shape) < clear * (1 - detection.missed)
    detected &= part[:, 1] > part[:, 0]
    pieces, whole = jax.vmap(break_up, in_axes=(0, 0, None))(
        segments, jax.random.uniform(break_key, (candidates, 3)), detection.broken
    )
    doubled = jax.vmap(both_edges, in_axes=(0, None))(segments, detection.apart)
    pieces = jnp.where(narrow[:, None, None, None], doubled, pieces)
    whole |= narrow[:, None]
    invented, there = invent(camera, detection, false_key)
    endpoints = jnp.concatenate([pieces.reshape(-1, 2, 2), invented])
    valid = jnp.concatenate([(detected[:, None] & whole).reshape(-1), there])
    draws = jax.random.normal(noise_key, (len(endpoints), 2, 2))
    endpoints = jax.vmap(disturb, in_axes=(0, 0, None))(endpoints, draws, detection)
    valid &= Segments(endpoints, valid).length >= detection.shortest
    longest, order = jax.lax.top_k(jnp.where(valid, Segments(endpoints, valid).length, 0), capacity)
    found = longest > 0
    packed = jnp.where(found[:, None, None], endpoints[order], 0)
    return Segments(packed, found), jnp.maximum(jnp.sum(valid) - capacity, 0)


def _where_positive(f: Float[Array, "2"]) -> Float[Array, "2"]:
    """Shares (from, to) of a segment on which an affine function, given at its ends, is positive.

    Empty if `to` is not greater than `from`.
    """
    cross = safe_divide(f[0], f[0] - f[1])
    low = jnp.where(f[0] >= 0, 0, jnp.where(f[1] > 0, cross, 1))
    high = jnp.where(f[1] >= 0, 1, jnp.where(f[0] > 0, cross, 0))
    return jnp.stack([low, high])


def _all_positive(f: Float[Array, "functions 2"]) -> Float[Array, "2"]:
    """Shares (from, to) on which several affine functions are all positive."""
    parts = jax.vmap(_where_positive)(f)
    return jnp.stack([parts[:, 0].max(), parts[:, 1].min()])


def in_picture(
    homogeneous: Float[Array, "2 3"], camera: Camera, max_depth: Float[Array, ""] | float
) -> Float[Array, "2"]:
    """Shares (from, to) of an edge that lie in the picture; affine in (x, y, 1) × depth."""
    x, y, depth = homogeneous.T
    right, bottom = camera.width - 1, camera.height - 1
    return _all_positive(
        jnp.stack([
            x, right * depth - x, y, bottom * depth - y, depth - NEAREST_DEPTH, max_depth - depth
        ])
    )  # fmt: skip


def project(homogeneous: Float[Array, "2 3"], part: Float[Array, "2"]) -> Float[Array, "2 2"]:
    """The end points in pixels of a part of an edge; finite, and without meaning if it is empty."""
    points = homogeneous[None, 0] + part[:, None] * (homogeneous[1] - homogeneous[0])[None]
    depth = jnp.maximum(points[:, 2:], NEAREST_DEPTH)
    return points[:, :2] / depth


def length_in_image(homogeneous: Float[Array, "2 3"], part: Float[Array, "2"]) -> Float[Array, ""]:
    """Pixels; zero if the part is empty."""
    a, b = project(homogeneous, part)
    return jnp.where(part[1] > part[0], safe_norm(b - a), 0)


def unhidden(
    plan: Float[Array, "2 2"], part: Float[Array, "2"], walls: Float[Array, "walls 2 2"]
) -> Float[Array, "2"]:
    """A part of an edge that no wall hides, grown from the first of the anchors that is seen.

    **Arguments:**
    - `plan`: the edge's end points in the plan, from the camera's foot.
    - `part`: shares (from, to) of the edge that lie in the picture.
    - `walls`: end points, from the camera's foot.

    **Returns:** shares (from, to) of the edge; empty if no anchor is seen.
    """
    low, high = jax.vmap(shadow, in_axes=(0, None))(walls, plan).T
    anchors = part[0] + jnp.array(ANCHORS) * (part[1] - part[0])
    hidden = jax.vmap(lambda at: jnp.any((low <= at) & (at < high)))(anchors)
    at = anchors[jnp.argmin(hidden)]
    begin = jnp.max(jnp.where((low < high) & (high <= at), high, 0), initial=0)
    end = jnp.min(jnp.where((low < high) & (low > at), low, 1), initial=1)
    seen = jnp.stack([jnp.maximum(begin, part[0]), jnp.minimum(end, part[1])])
    return jnp.where(jnp.all(hidden), jnp.zeros(2), seen)


def shadow(wall: Float[Array, "2 2"], plan: Float[Array, "2 2"]) -> Float[Array, "2"]:
    """Shares (from, to) of an edge in the plan in a wall's shadow, the eye at the origin."""
    a, b = wall
    turn = jnp.sign(_cross(a, b))
    beyond = turn * safe_divide(_cross(b - a, plan - a[None]), safe_norm(b - a)) * -1
    f = jnp.stack([turn * _cross(a, plan), turn * -_cross(b, plan), beyond - WALL_DEPTH])
    return jnp.where(turn == 0, jnp.zeros(2), _all_positive(f))


def _cross(a: Float[Array, "2"], b: Float[Array, "*batch 2"]) -> Float[Array, "*batch"]:
    return a[0] * b[..., 1] - a[1] * b[..., 0]


def break_up(
    segment: Float[Array, "2 2"], draws: Float[Array, "3"], broken: Float[Array, ""] | float
) -> tuple[Float[Array, "2 2 2"], Bool[Array, "2"]]:
    """One piece, or two with a gap, and which of the two are there; by three draws from 0 to 1."""
    chance, place, gap = draws
    breaks = chance < broken
    middle = 0.2 + 0.6 * place
    ends = jnp.stack([middle * (1 - 0.2 * gap), middle + (1 - middle) * 0.2 * gap])
    inner = segment[None, 0] + ends[:, None] * (segment[1] - segment[0])[None]
    first = jnp.stack([segment[0], jnp.where(breaks, inner[0], segment[1])])
    return jnp.stack([first, jnp.stack([inner[1], segment[1]])]), jnp.stack([breaks | True, breaks])


def both_edges(
    segment: Float[Array, "2 2"], apart: Float[Array, ""] | float
) -> Float[Array, "2 2 2"]:
    """The two edges of a narrow line, beside its middle in the image."""
    shift = apart / 2 * _normal(segment)
    return jnp.stack([segment + shift[None], segment - shift[None]])


def _normal(segment: Float[Array, "2 2"]) -> Float[Array, "2"]:
    """The unit vector across a segment; zero if it has no length."""
    d = segment[1] - segment[0]
    return safe_divide(jnp.stack([-d[1], d[0]]), jnp.broadcast_to(safe_norm(d), (2,)))


def invent(
    camera: Camera, detection: Detection, key: PRNGKeyArray
) -> tuple[Float[Array, "false 2 2"], Bool[Array, "false"]]:
    """Segments of nothing, anywhere in the picture and in any direction."""
    count_key, place_key, angle_key, length_key = jax.random.split(key, 4)
    there = jax.random.uniform(count_key, (FALSE_SLOTS,)) < detection.false_segments / FALSE_SLOTS
    size = jnp.array([camera.width - 1, camera.height - 1], float)
    middle = jax.random.uniform(place_key, (FALSE_SLOTS, 2)) * size[None]
    angle = jax.random.uniform(angle_key, (FALSE_SLOTS,)) * jnp.pi
    half = detection.shortest / 2 + 10 * jax.random.exponential(length_key, (FALSE_SLOTS,))
    reach = half[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    ends = jnp.stack([middle - reach, middle + reach], axis=1)
    return jnp.clip(ends, 0, size[None, None]), there


def disturb(
    segment: Float[Array, "2 2"], draws: Float[Array, "2 2"], detection: Detection
) -> Float[Array, "2 2"]:
    """Noise across the line at both ends, and each end drawn in along it; by normal draws."""
    across, along = draws
    normal = _normal(segment)
    unit = jnp.stack([normal[1], -normal[0]])
    short = jnp.abs(along) * jnp.array([1.0, -1.0]) * detection.shortening
    return segment + detection.noise * across[:, None] * normal[None] + short[:, None] * unit[None]
