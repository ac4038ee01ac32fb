"""Which part of a straight edge is in the picture, and not behind a wall."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sofjax.geometry.angles import safe_divide, safe_norm
from sofjax.geometry.camera import Camera

NEAREST_DEPTH = 0.1  # metres before the camera
WALL_DEPTH = 0.05  # metres behind a wall's face: what is fixed to it is not hidden by it
ANCHORS = (0.5, 0.2, 0.8, 0.05, 0.95)  # shares of an edge from which its visible part is grown


def where_positive(f: Float[Array, "2"]) -> Float[Array, "2"]:
    """Shares (from, to) of a segment on which an affine function, given at its ends, is positive.

    Empty if `to` is not greater than `from`.
    """
    cross = safe_divide(f[0], f[0] - f[1])
    low = jnp.where(f[0] >= 0, 0, jnp.where(f[1] > 0, cross, 1))
    high = jnp.where(f[1] >= 0, 1, jnp.where(f[0] > 0, cross, 0))
    return jnp.stack([low, high])


def _all_positive(f: Float[Array, "functions 2"]) -> Float[Array, "2"]:
    """Shares (from, to) on which several affine functions are all positive."""
    parts = jax.vmap(where_positive)(f)
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
    - `plan`: the edge's end points in the plan, from the camera's nadir.
    - `part`: shares (from, to) of the edge that lie in the picture.
    - `walls`: end points, from the camera's nadir.

    **Returns:** shares (from, to) of the edge; empty if no anchor is seen.
    """
    low, high = jax.vmap(shadow, in_axes=(0, None))(walls, plan).T
    anchors = part[0] + jnp.array(ANCHORS) * (part[1] - part[0])
    truncated = jax.vmap(lambda at: jnp.any((low <= at) & (at < high)))(anchors)
    at = anchors[jnp.argmin(truncated)]
    begin = jnp.max(jnp.where((low < high) & (high <= at), high, 0), initial=0)
    end = jnp.min(jnp.where((low < high) & (low > at), low, 1), initial=1)
    seen = jnp.stack([jnp.maximum(begin, part[0]), jnp.minimum(end, part[1])])
    return jnp.where(jnp.all(truncated), jnp.zeros(2), seen)


def shadow(wall: Float[Array, "2 2"], plan: Float[Array, "2 2"]) -> Float[Array, "2"]:
    """Shares (from, to) of an edge in the plan in a wall's shadow, the eye at the origin."""
    a, b = wall
    turn = jnp.sign(_cross(a, b))
    beyond = turn * safe_divide(_cross(b - a, plan - a[None]), safe_norm(b - a)) * -1
    f = jnp.stack([turn * _cross(a, plan), turn * -_cross(b, plan), beyond - WALL_DEPTH])
    return jnp.where(turn == 0, jnp.zeros(2), _all_positive(f))


def _cross(a: Float[Array, "2"], b: Float[Array, "*batch 2"]) -> Float[Array, "*batch"]:
    return a[0] * b[..., 1] - a[1] * b[..., 0]
