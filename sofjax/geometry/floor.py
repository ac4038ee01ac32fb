"""Between the floor and one image of it; eqs. (6) and (10) to (13)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sofjax.geometry.camera import Camera, Mount, projection_matrix
from sofjax.geometry.lines import line_point_distance
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import clip


def floor_homography(camera: Camera, mount: Mount, T_world_robot: SE2) -> Float[Array, "3 3"]:
    """H_F = [p1 p2 p4], from the floor (X, Y, 1) to the image (x, y, 1); eqs. (10) and (11).

    **Arguments:**
    - `camera`, `mount`: pixels; metres and radians.
    - `T_world_robot`: one pose on the floor; with the identity H_F is about the robot frame.

    **Returns:** H_F with x ~ H_F X, scaled so that the third component of H_F X is the depth in
    metres; invertible unless the optical centre lies in the floor.
    """
    P = projection_matrix(camera, mount, T_world_robot)
    return P[:, jnp.array([0, 1, 3])]


def image_to_floor(
    H_F: Float[Array, "3 3"], point_image: Float[Array, "2"]
) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """X = H_F^-1 x; eq. (12).

    **Returns:** the floor point in metres, and whether the pixel sees the floor at all: the third
    component of H_F^-1 x is 1 / depth, positive below the horizon only. Where it does not, the
    point is finite and without meaning.
    """
    X, Y, inverse_depth = jnp.linalg.inv(H_F) @ jnp.append(point_image, 1.0)
    visible = inverse_depth > 0
    return jnp.stack([X, Y]) / jnp.where(visible, inverse_depth, 1), visible


def floor_to_image(
    H_F: Float[Array, "3 3"], point_floor: Float[Array, "2"]
) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """x ~ H_F X; eq. (11).

    **Returns:** the pixel, and whether the point lies before the camera. The image's borders are
    not looked at.
    """
    x, y, depth = H_F @ jnp.append(point_floor, 1.0)
    visible = depth > 0
    return jnp.stack([x, y]) / jnp.where(visible, depth, 1), visible


def may_be_upright(
    nadir_image: Float[Array, "3"],
    segment_image: Float[Array, "2 2"],
    gate: Float[Array, ""] | float,
) -> Bool[Array, ""]:
    """Whether a segment's ends are within `gate` pixels of a line through its middle and the nadir.

    The image of the nadir (homogeneous) is where the images of all uprights meet: an edge of a door
    or a box always points there, and over a short motion it moves like a line of the floor.
    """
    line = jnp.cross(nadir_image, jnp.append(segment_image.mean(axis=0), 1))
    return jnp.abs(line_point_distance(line, segment_image[0])) < gate


def segment_to_floor(
    H_F: Float[Array, "3 3"], segment_image: Float[Array, "2 2"], max_depth: Float[Array, ""]
) -> tuple[Float[Array, "2 2"], Bool[Array, ""]]:
    """A segment projected to the floor by one inverse projection; eqs. (12) and (13).

    1 / depth is affine in the image: the part above the horizon or farther than `max_depth`
    metres is clipped away, exactly, before anything is divided.

    **Returns:** end points on the floor in metres, and whether any part lies there.
    """
    inverse = jnp.linalg.inv(H_F)
    homogeneous = jnp.concatenate([segment_image, jnp.ones((2, 1))], axis=1)
    inverse_depth = homogeneous @ inverse[2]
    near, some = clip(segment_image, inverse_depth - 1 / max_depth)
    X = jnp.concatenate([near, jnp.ones((2, 1))], axis=1) @ inverse.T
    return X[:, :2] / jnp.where(some, X[:, 2:], 1), some


def line_to_floor(H_F: Float[Array, "3 3"], line_image: Float[Array, "3"]) -> Float[Array, "3"]:
    """L = H_F^T l, the floor line that an image line comes from; eq. (13)."""
    return H_F.T @ line_image


def line_to_image(H_F: Float[Array, "3 3"], line_floor: Float[Array, "3"]) -> Float[Array, "3"]:
    """l = H_F^-T L, the inverse of eq. (13)."""
    return jnp.linalg.solve(H_F.T, line_floor)


def horizon(H_F: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The image line of the floor's points at infinity, scaled so that l·(x, y, 1) = 1 / depth."""
    return jnp.linalg.inv(H_F)[2]
