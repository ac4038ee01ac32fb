"""The homography that the floor induces between two images; eqs. (4) to (8)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sofjax.geometry.camera import Camera, Mount, rotation_robot_camera, rotation_z
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import clip


def two_view_homography(camera: Camera, mount: Mount, T_first_second: SE2) -> Float[Array, "3 3"]:
    """H with x' ~ H x for the floor seen before and after a motion of the robot; eqs. (7) and (8).

    Differs from the paper: eq. (8) has the floor's normal along the camera's optical axis, as if
    camera and world axes were one. Here it is turned by R0, the tilt of the mount, and R̄, t̄ move
    the camera centre, so that the lever arm counts:
    H = K R0 (R̄ - t̄ nᵀ/h) R0ᵀ K^-1, equal to H_F' H_F^-1 up to scale.

    **Arguments:**
    - `camera`, `mount`: pixels; metres and radians. Only motion over `height` matters.
    - `T_first_second`: the robot's motion, metres and radians.

    **Returns:** H in pixels.
    """
    T_second_first = T_first_second.inverse()
    nadir = mount.T_robot_nadir.xy
    R = rotation_z(T_second_first.yaw)  # R̄ of eq. (5)
    t = T_second_first.apply(nadir) - nadir  # t̄ of eq. (5); its third component is 0
    h, n = mount.height, jnp.array([0.0, 0.0, 1.0])  # eq. (6): n·X + h = 0
    R0 = rotation_robot_camera(mount).T
    body = R - jnp.outer(jnp.append(t, 0.0), n) / h  # eq. (7)
    return camera.K @ R0 @ body @ R0.T @ jnp.linalg.inv(camera.K)  # eq. (8)


def transfer_segment(
    H: Float[Array, "3 3"], segment: Float[Array, "2 2"], min_depth_ratio: float = 0.05
) -> tuple[Float[Array, "2 2"], Bool[Array, ""]]:
    """x'' ~ H x for both ends of a segment of the floor.

    The third component of H x is the ratio of the depths after and before the motion: what the
    robot has driven past lies behind the camera, and is clipped away where the ratio falls below
    `min_depth_ratio`.

    **Returns:** end points in the second image, pixels, and whether any part is before the camera.
    """
    ratio = segment @ H[2, :2] + H[2, 2]
    ahead, some = clip(segment, ratio - min_depth_ratio)
    x = jnp.concatenate([ahead, jnp.ones((2, 1))], axis=1) @ H.T
    return x[:, :2] / jnp.where(some, x[:, 2:], 1), some
