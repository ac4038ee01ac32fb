"""The camera and where it sits on the robot; eqs. (1) and (2)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sofjax.geometry.se2 import SE2


class Camera(eqx.Module):
    """Intrinsics of a pinhole camera without distortion: the front end undistorts the images."""

    K: Float[Array, "3 3"]  # calibration matrix, pixels
    width: int = eqx.field(static=True)  # pixels
    height: int = eqx.field(static=True)  # pixels


class Mount(eqx.Module):
    """Pose of the camera in the robot frame (x forward, y left, z up, on the floor under the axle).

    `pitch > 0` looks down. The fields are in the order in which a fit of the mount reports them.
    """

    x: Float[Array, ""]  # metres, the lever arm of every turn
    y: Float[Array, ""]  # metres
    height: Float[Array, ""]  # h, metres above the floor
    pitch: Float[Array, ""]  # radians
    roll: Float[Array, ""]  # radians
    yaw: Float[Array, ""]  # radians

    @staticmethod
    def create(
        height: float,
        pitch: float = 0.0,
        *,
        x: float = 0.0,
        y: float = 0.0,
        roll: float = 0.0,
        yaw: float = 0.0,
    ) -> "Mount":
        """A mount from plain numbers, metres and radians."""
        return Mount(*(jnp.asarray(value, float) for value in (x, y, height, pitch, roll, yaw)))

    def tilted(self, pitch: Float[Array, ""], roll: Float[Array, ""]) -> "Mount":
        """This mount with `pitch` and `roll` added to its own, radians."""
        return Mount(self.x, self.y, self.height, self.pitch + pitch, self.roll + roll, self.yaw)

    @property
    def T_robot_nadir(self) -> SE2:
        """The nadir: the floor point under the optical centre, with the axes of the robot."""
        xy = jnp.stack([self.x, self.y])
        return SE2(xy, jnp.zeros_like(self.x))


def rotation_robot_camera(mount: Mount) -> Float[Array, "3 3"]:
    """R_robot_camera = Rz(yaw) Ry(pitch) Rx(roll) A, with A the optical axes in the robot's."""
    A = jnp.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return rotation_z(mount.yaw) @ rotation_y(mount.pitch) @ rotation_x(mount.roll) @ A


def projection_matrix(camera: Camera, mount: Mount, T_world_robot: SE2) -> Float[Array, "3 4"]:
    """P = K R [I | -C], from world points (X, Y, Z, 1) to image points (x, y, 1); eqs. (1) and (2).

    **Arguments:**
    - `camera`, `mount`: pixels; metres and radians.
    - `T_world_robot`: one pose of the robot, metres and radians.

    **Returns:** P, scaled so that the third component of P X is the depth in metres.
    """
    R_world_camera = rotation_z(T_world_robot.yaw) @ rotation_robot_camera(mount)
    C = jnp.append(T_world_robot.apply(mount.T_robot_nadir.xy), mount.height)
    R = R_world_camera.T
    return camera.K @ jnp.concatenate([R, -(R @ C)[:, None]], axis=1)


def rotation_x(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    c, s, o, i = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.stack([i, o, o, o, c, -s, o, s, c]).reshape(3, 3)


def rotation_y(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    c, s, o, i = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.stack([c, o, s, o, i, o, -s, o, c]).reshape(3, 3)


def rotation_z(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    c, s, o, i = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.stack([c, -s, o, s, c, o, o, o, i]).reshape(3, 3)
