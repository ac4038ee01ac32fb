"""Observations without an image: the edges of a world as a detector would report them.

Pure functions of one image, mapped over the images of a drive and, by `jax.vmap`, over drives.
What hides an edge are the walls in the plan, exactly, by the shadow that each wall throws from
the camera; boxes hide nothing. Of an edge that is seen in several parts, one part is reported.

A line of some millimetres is seen as its two edges. It is w pixels broad in the image, less the
farther it is, and a blur of standard deviation b leaves the share erf(w / √8 b) of its contrast:
it fades with distance. The two slopes that are left have their middles w / share apart, on either
side of the line: that is √(2π) b for the finest line and w for a broad one.
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
    width: Float[Array, "*batch edges"]  # metres, of a line that is seen as two edges; others 0
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
        raise ValueError(f"the world has {len(rows)} {what} where there is room for {length}")
    return np.concatenate([rows, np.zeros((length - len(rows), *rows.shape[1:]), rows.dtype)])


class Detection(eqx.Module):
    """How a line detector errs; the defaults are those of LSD on 320×240 pixels.

    `blur` and the contrasts were found on drawn images of fine lines; that the filter errs on such
    segments as on the images of the same drives is shown by `experiments/ablation`.
    """

    noise: float = 0.25  # pixels, standard deviation of an end across the line
    shortening: float = 1.5  # pixels that an end is short of the edge's, mean size
    missed: float = 0.1  # share of edges of good contrast that are not seen
    least_contrast: float = 0.04  # step of brightness below which no edge is seen
    full_contrast: float = 0.1  # ... and from which its contrast is good; between, in proportion
    blur: float = 1.05  # pixels, standard deviation: lens, pixels and detector together
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

    # Inside the picture, and of some length there; fine lines no farther than they can be seen
    breadth = jax.vmap(breadth_in_image, in_axes=(0, 0, 0, None))(
        homogeneous, scene.edges_world, scene.width, P
    )
    reach = seen_until(breadth, scene.contrast, detection.least_contrast, detection)
    part = jax.vmap(in_picture, in_axes=(0, None, 0))(homogeneous, camera, reach)
    length = jax.vmap(length_in_image)(homogeneous, part)
    candidates = min(CANDIDATES, len(scene.contrast))
    length, chosen = jax.lax.top_k(jnp.where(scene.contrast > 0, length, 0), candidates)
    homogeneous, part, breadth = homogeneous[chosen], part[chosen], breadth[chosen]
    plan = scene.edges_world[chosen, :, :2] - C[None, None]

    # Not behind a wall
    part = jax.vmap(unhidden, in_axes=(0, 0, None))(plan, part, scene.walls_world - C[None, None])
    segments = jax.vmap(project)(homogeneous, part)

    # As a detector reports them, each of the two edges of a fine line by a draw of its own
    miss_key, break_key, false_key, noise_key = jax.random.split(key, 4)
    seldom = jax.random.uniform(miss_key, (candidates, 2)) / (1 - detection.missed)
    wanted = detection.least_contrast + seldom * (
        detection.full_contrast - detection.least_contrast
    )
    wanted = jnp.where(seldom < 1, wanted, jnp.inf)
    reach = seen_until(breadth[:, None], scene.contrast[chosen, None], wanted, detection)
    pieces, whole = jax.vmap(break_up, in_axes=(0, 0, None))(
        segments, jax.random.uniform(break_key, (candidates, 3)), detection.broken
    )
    whole &= ((part[:, 1] > part[:, 0]) & (reach[:, 0] > 0))[:, None]
    edges, seen = jax.vmap(both_edges, in_axes=(0, 0, 0, 0, None))(
        homogeneous, part, breadth, reach, detection.blur
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


def breadth_in_image(
    homogeneous: Float[Array, "2 3"],
    edge_world: Float[Array, "2 3"],
    width: Float[Array, ""],
    P: Float[Array, "3 4"],
) -> Float[Array, ""]:
    """How broad a floor line of some width is in the image, as pixels × metres of depth.

    Across a straight line in the image this is the same all along it.
    """
    line = jnp.cross(homogeneous[0], homogeneous[1])
    across = jnp.append(_normal(edge_world[:, :2]), 0)
    return width * jnp.abs(safe_divide(line @ (P[:, :3] @ across), safe_norm(line[:2])))


def share_left(w: Float[Array, "*any"], blur: Float[Array, ""] | float) -> Float[Array, "*any"]:
    """Share of its contrast that a line `w` pixels broad keeps when blurred."""
    return jax.scipy.special.erf(w / (8**0.5 * blur))


def seen_until(
    breadth: Float[Array, "*#any"],
    contrast: Float[Array, "*#any"],
    wanted: Float[Array, "*#any"] | Float[Array, ""] | float,
    detection: Detection,
) -> Float[Array, "*#any"]:
    """Depth in metres at which an edge's contrast falls to what is wanted; 0 if it is less at once.

    A line without breadth is an edge that does not fade, seen to `max_depth`.
    """
    least = 8**0.5 * detection.blur * jax.scipy.special.erfinv(safe_divide(wanted, contrast))
    fades = jnp.where(breadth > 0, breadth / jnp.maximum(least, 1e-6), jnp.inf)
    return jnp.where(wanted < contrast, jnp.minimum(fades, detection.max_depth), 0)


def both_edges(
    homogeneous: Float[Array, "2 3"],
    part: Float[Array, "2"],
    breadth: Float[Array, ""],
    reach: Float[Array, "2"],
    blur: Float[Array, ""] | float,
) -> tuple[Float[Array, "2 2 2"], Bool[Array, "2"]]:
    """The two edges of a fine line, beside its middle in the image, and which of them are there.

    They run in opposite directions, as with the darker side on one hand.

    **Arguments:**
    - `part`: shares (from, to) of the line that are in sight.
    - `reach`: depth in metres to which either edge is seen.
    """
    depth = homogeneous[:, 2]

    def edge(reach: Float[Array, ""], side: Float[Array, ""]) -> tuple[Array, Array]:
        near = _where_positive(reach - depth)
        seen = jnp.stack([jnp.maximum(part[0], near[0]), jnp.minimum(part[1], near[1])])
        ends = project(homogeneous, seen)
        w = breadth / jnp.maximum(depth[0] + seen * (depth[1] - depth[0]), NEAREST_DEPTH)
        away = jnp.maximum(w, 1e-3) / share_left(jnp.maximum(w, 1e-3), blur) / 2
        return ends + side * away[:, None] * _normal(ends)[None], seen[1] > seen[0]

    ends, there = jax.vmap(edge)(reach, jnp.array([1.0, -1.0]))
    return jnp.stack([ends[0], ends[1, ::-1]]), there


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
