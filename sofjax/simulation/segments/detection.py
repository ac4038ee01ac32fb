"""The segments that a line detector finds of the edges in view, with its errors.

A line of some millimetres is detected as its two edges. It is w pixels broad in the image. A blur
of standard deviation b leaves the share erf(w / √8 b) of its contrast, so it fades with distance.
The middles of its two blurred edges are w / share apart: √(2π) b for the finest line and w for a
broad one.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sofjax._checks import check_fields
from sofjax.geometry.angles import safe_divide, safe_norm
from sofjax.geometry.camera import Camera
from sofjax.simulation.segments.visibility import NEAREST_DEPTH, project, where_positive

FALSE_SLOTS = 8  # false segments of an image at most


class Detection(eqx.Module):
    """How a line detector errs; the defaults are those of LSD on 320×240 pixels.

    `blur` and the contrasts were measured on drawn images of fine lines. The ablation study
    compares the filter's errors on such segments with those on images of the same drives.
    """

    noise: float = 0.25  # pixels, standard deviation of an end across the line
    shortening: float = 1.5  # pixels that an end is short of the edge's, mean size
    missed: float = 0.1  # share of edges of good contrast that are not detected
    min_contrast: float = 0.04  # step of brightness below which no edge is detected
    full_contrast: float = 0.1  # from which it is detected as well as any; linear between the two
    blur: float = 1.05  # pixels, standard deviation: lens, pixels and detector together
    broken: float = 0.25  # share of edges that come in two pieces
    false_segments: float = 2.0  # mean number an image
    shortest: float = 15.0  # pixels
    max_depth: float = 10.0  # metres

    def __check_init__(self) -> None:
        shares = ("missed", "broken")
        sizes = ("noise", "shortening", "min_contrast", "false_segments", "shortest")
        check_fields(
            self, at_least_zero=(*shares, *sizes), positive=("full_contrast", "blur", "max_depth")
        )


LSD = Detection()


def break_up(
    segment: Float[Array, "2 2"], draws: Float[Array, "3"], broken: Float[Array, ""] | float
) -> tuple[Float[Array, "2 2 2"], Bool[Array, "2"]]:
    """One piece, or two with a gap, and which of the two exist; by three draws from 0 to 1."""
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
    """Breadth of a floor line in the image, in pixels × metres of depth.

    It is the same all along the line.
    """
    line = jnp.cross(homogeneous[0], homogeneous[1])
    across = jnp.append(normal_of(edge_world[:, :2]), 0)
    return width * jnp.abs(safe_divide(line @ (P[:, :3] @ across), safe_norm(line[:2])))


def share_left(w: Float[Array, "*any"], blur: Float[Array, ""] | float) -> Float[Array, "*any"]:
    """Share of its contrast that is left of a line `w` pixels broad after the blur."""
    return jax.scipy.special.erf(w / (8**0.5 * blur))


def seen_until(
    breadth: Float[Array, "*#any"],
    contrast: Float[Array, "*#any"],
    wanted: Float[Array, "*#any"] | Float[Array, ""] | float,
    detection: Detection,
) -> Float[Array, "*#any"]:
    """Depth in metres up to which an edge has the wanted contrast; 0 if it never has.

    A line without breadth is an edge that does not fade, seen to `max_depth`.
    """
    needed = (
        8**0.5
        * detection.blur
        * jax.scipy.special.erfinv(safe_divide(jnp.asarray(wanted), contrast))
    )
    fades = jnp.where(breadth > 0, breadth / jnp.maximum(needed, 1e-6), jnp.inf)
    return jnp.where(wanted < contrast, jnp.minimum(fades, detection.max_depth), 0)


def both_edges(
    homogeneous: Float[Array, "2 3"],
    part: Float[Array, "2"],
    breadth: Float[Array, ""],
    depth_seen: Float[Array, "2"],
    blur: Float[Array, ""] | float,
) -> tuple[Float[Array, "2 2 2"], Bool[Array, "2"]]:
    """The two edges of a fine line in the image, and which of them exist.

    They run in opposite directions, as with the darker side on one hand.

    **Arguments:**
    - `part`: shares (from, to) of the line that are in view.
    - `depth_seen`: depth in metres to which either edge is seen.
    """
    depth = homogeneous[:, 2]

    def edge(depth_seen: Float[Array, ""], side: Float[Array, ""]) -> tuple[Array, Array]:
        near = where_positive(depth_seen - depth)
        seen = jnp.stack([jnp.maximum(part[0], near[0]), jnp.minimum(part[1], near[1])])
        ends = project(homogeneous, seen)
        w = breadth / jnp.maximum(depth[0] + seen * (depth[1] - depth[0]), NEAREST_DEPTH)
        away = jnp.maximum(w, 1e-3) / share_left(jnp.maximum(w, 1e-3), blur) / 2
        return ends + side * away[:, None] * normal_of(ends)[None], seen[1] > seen[0]

    ends, there = jax.vmap(edge)(depth_seen, jnp.array([1.0, -1.0]))
    return jnp.stack([ends[0], ends[1, ::-1]]), there


def normal_of(segment: Float[Array, "2 2"]) -> Float[Array, "2"]:
    """The unit vector across a segment; zero if it has no length."""
    d = segment[1] - segment[0]
    return safe_divide(jnp.stack([-d[1], d[0]]), jnp.broadcast_to(safe_norm(d), (2,)))


def invent(
    camera: Camera, detection: Detection, key: PRNGKeyArray
) -> tuple[Float[Array, "false 2 2"], Bool[Array, "false"]]:
    """False segments, anywhere in the picture and in any direction."""
    count_key, place_key, angle_key, length_key = jax.random.split(key, 4)
    there = jax.random.uniform(count_key, (FALSE_SLOTS,)) < detection.false_segments / FALSE_SLOTS
    size = jnp.array([camera.width - 1, camera.height - 1], float)
    middle = jax.random.uniform(place_key, (FALSE_SLOTS, 2)) * size[None]
    angle = jax.random.uniform(angle_key, (FALSE_SLOTS,)) * jnp.pi
    half = detection.shortest / 2 + 10 * jax.random.exponential(length_key, (FALSE_SLOTS,))
    offset = half[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    ends = jnp.stack([middle - offset, middle + offset], axis=1)
    return jnp.clip(ends, 0, size[None, None]), there


def disturb(
    segment: Float[Array, "2 2"], draws: Float[Array, "2 2"], detection: Detection
) -> Float[Array, "2 2"]:
    """The segment with noise across it at both ends, and shortened at both; by normal draws."""
    across, along = draws
    normal = normal_of(segment)
    unit = jnp.stack([normal[1], -normal[0]])
    short = jnp.abs(along) * jnp.array([1.0, -1.0]) * detection.shortening
    return segment + detection.noise * across[:, None] * normal[None] + short[:, None] * unit[None]
