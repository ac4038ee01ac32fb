"""Where rays end in a world: the nearest of floor, ceiling, walls and boxes.

Six rays leave every pixel. Which surface hides which, and where an edge lies, is exact.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32

from sofjax.simulation.rendering.texture_atlas import Atlas
from sofjax.simulation.world.types import World

# Where the rays of a pixel pass through it: no two in one row or column, so that edges along
# either axis are smoothed in six steps.
RAYS = (np.array([[0, 3], [1, 0], [2, 4], [3, 1], [4, 5], [5, 2]]) - 2.5) / 6
NEAR_FLOOR = 4.0  # metres along the view; beyond, the floor's coarse picture is used
SPREAD = (0.65, 0.8, 1.0, 1.25, 1.55)  # of a rough floor's mirrored rays, drawn out along the view
MIRROR_TEXELS = 20.0  # per metre, of the lamps as the floor mirrors them


def in_view(
    atlas: Atlas, R_world_camera: np.ndarray, C: np.ndarray
) -> tuple[Float[Array, "faces 10"], Float[Array, "tops 7"]]:
    """Faces and tops that the camera may see, as the rows that `cast` takes."""
    faces, tops = atlas.faces, atlas.tops
    nadir, ahead = C[:2], R_world_camera[:2, 2]
    to_start = faces.start - nadir
    normal = np.stack([-faces.along[:, 1], faces.along[:, 0]], axis=-1)
    distance = -(to_start * normal).sum(1)  # of the camera in front of the face
    ends = np.stack([to_start, to_start + faces.length[:, None] * faces.along], axis=1)
    seen = (distance > 1e-3) & ((ends @ ahead).max(1) > -2.0)
    g = -normal / np.where(seen, distance, 1)[:, None]  # 1 / depth of the face along d is g·d
    s0 = -(to_start * faces.along).sum(1)
    face_rows = np.column_stack(
        [g, faces.along, s0, faces.length, faces.height, faces.origin, np.ones(len(s0))]
    )[seen]
    below = tops.height < C[2]
    rise = np.where(below, C[2] - tops.height, 1)
    top_rows = np.column_stack([1 / rise, tops.rect - np.tile(nadir, 2), tops.origin])[below]
    return _padded(face_rows, 8), _padded(top_rows, 4)


def _padded(rows: np.ndarray, multiple: int) -> Array:
    """Rows of zeros added, so that only few lengths occur and `cast` is seldom compiled."""
    short = -len(rows) % multiple
    return jnp.asarray(np.pad(rows, ((0, short), (0, 0))), jnp.float32)


class Frame(eqx.Module):
    """What all rays of a frame share; a picture is its column, row and texels a metre."""

    R_world_camera: Float32[Array, "3 3"]
    C: Float32[Array, "3"]  # metres
    ceiling: Float32[Array, ""]  # metres
    gloss: Float32[Array, ""]
    corner: Float32[Array, "2"]  # lower left of the plan, metres
    texels: Float32[Array, ""]  # per metre, of faces and tops
    floor: Float32[Array, "3"]
    far_floor: Float32[Array, "3"]
    over: Float32[Array, "3"]


def frame_of(world: World, atlas: Atlas, R_world_camera: np.ndarray, C: np.ndarray) -> Frame:
    corner = world.corridors[:, :2].min(0)
    pictures = [
        np.append(p.origin, p.texels) for p in (atlas.floor, atlas.far_floor, atlas.ceiling)
    ]
    shared = (R_world_camera, C, world.ceiling, world.look.gloss, corner, atlas.texels, *pictures)
    return Frame(*(jnp.asarray(value, jnp.float32) for value in shared))


@jax.jit
def cast(
    rays: Float32[Array, "3 rays"],
    frame: Frame,
    faces: Float32[Array, "faces 10"],
    tops: Float32[Array, "tops 7"],
) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """Where each ray ends, as column and row of the atlas.

    Nearness, the inverse of the distance along a ray, is affine in its direction for every plane,
    so the nearest surface is found without a division.

    **Returns:** columns and rows of the atlas [rays]; and for the first ray of every pixel the
    columns and rows [SPREAD, pixels] of the lamps that it sees mirrored, and how strongly.
    """
    x, y, height = frame.C
    dx, dy, dz = frame.R_world_camera @ rays
    nearest = jnp.zeros_like(dx)  # nearness of the nearest face
    along = jnp.zeros_like(dx)  # nearness × metres along the face
    column0, row0 = jnp.zeros_like(dx), jnp.zeros_like(dx)
    for i in range(faces.shape[0]):
        gx, gy, ux, uy, s0, length, top, column, row, exists = faces[i]
        near = gx * dx + gy * dy
        s = s0 * near + ux * dx + uy * dy
        inside = (s >= 0) & (s <= length * near) & (dz <= (top - height) * near)
        closer = inside & (near > nearest) & (exists > 0)
        nearest = jnp.where(closer, near, nearest)
        along = jnp.where(closer, s, along)
        column0, row0 = jnp.where(closer, column, column0), jnp.where(closer, row, row0)
    is_top = jnp.zeros_like(dx, bool)
    for i in range(tops.shape[0]):
        inverse_rise, x0, y0, x1, y1, column, row = tops[i]
        near = -dz * inverse_rise
        inside = (dx >= x0 * near) & (dx <= x1 * near) & (dy >= y0 * near) & (dy <= y1 * near)
        closer = inside & (near > nearest) & (inverse_rise > 0)
        nearest = jnp.where(closer, near, nearest)
        column0, row0 = jnp.where(closer, column, column0), jnp.where(closer, row, row0)
        is_top = is_top | closer

    floor, above = -dz / height, dz / (frame.ceiling - height)
    level = jnp.maximum(floor, above)
    on_face = nearest >= level
    distance = 1 / jnp.maximum(jnp.where(on_face, nearest, level), 1e-4)
    column, row, scale = (
        jnp.where(dz < 0, jnp.where(distance < NEAR_FLOOR, near, far), over)
        for near, far, over in zip(frame.floor, frame.far_floor, frame.over, strict=True)
    )
    px, py, pz = x + distance * dx, y + distance * dy, height + distance * dz
    face_columns = column0 + frame.texels * jnp.where(is_top, px, along * distance)
    face_rows = row0 + frame.texels * jnp.where(is_top, py, pz)
    columns = jnp.where(on_face, face_columns, column + scale * px)
    rows = jnp.where(on_face, face_rows, row + scale * py)

    first = rays.shape[1] // len(RAYS)
    dx, dy, dz, nearest, floor = (v[:first] for v in (dx, dy, dz, nearest, floor))
    beyond = (1 + frame.ceiling / height) / jnp.maximum(floor, 1e-4)  # to the mirrored ceiling
    grazing = 1 + dz / jnp.sqrt(dx * dx + dy * dy + dz * dz)
    mirrors = (floor > nearest) & (nearest * beyond < 1)
    strength = jnp.where(mirrors, frame.gloss * (0.1 + 0.9 * grazing**3), 0)
    spread = [beyond * share for share in SPREAD]
    x, y = frame.C[:2] - frame.corner
    mirror_columns = jnp.stack([(x + r * dx) * MIRROR_TEXELS - 0.5 for r in spread])
    mirror_rows = jnp.stack([(y + r * dy) * MIRROR_TEXELS - 0.5 for r in spread])
    return columns, rows, (mirror_columns, mirror_rows, strength)
