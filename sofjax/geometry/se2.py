"""Rigid motions of the floor plane."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sofjax.geometry.angles import wrap


class SE2(eqx.Module):
    """A pose or a motion on the floor, `T_a_b`: it maps coordinates of frame b into frame a.

    Batches carry their axes in front: `xy[*batch, 2]`, `yaw[*batch]`.
    """

    xy: Float[Array, "*batch 2"]  # origin of b in a, metres
    yaw: Float[Array, "*batch"]  # radians, counter-clockwise

    @staticmethod
    def identity() -> "SE2":
        return SE2(jnp.zeros(2), jnp.zeros(()))

    def rotate(self, vectors: Float[Array, "*points 2"]) -> Float[Array, "... 2"]:
        """Turn vectors, whose axes in front broadcast against the batch's."""
        # a stack of sums would make XLA recompute cosine and sine for each number
        c, s = jnp.cos(self.yaw)[..., None], jnp.sin(self.yaw)[..., None]
        return c * vectors + s * _quarter_turn(vectors)

    def apply(self, points: Float[Array, "*points 2"]) -> Float[Array, "... 2"]:
        """Points of frame b in frame a, metres."""
        return self.rotate(points) + self.xy

    def __matmul__(self, T_b_c: "SE2") -> "SE2":
        """T_a_c = T_a_b @ T_b_c; the yaw is not wrapped, so that paths keep their turns."""
        return SE2(self.apply(T_b_c.xy), self.yaw + T_b_c.yaw)

    def inverse(self) -> "SE2":
        """T_b_a."""
        back = SE2(jnp.zeros_like(self.xy), -self.yaw)
        return SE2(-back.rotate(self.xy), -self.yaw)

    def between(self, T_a_c: "SE2") -> "SE2":
        """T_b_c, of self = T_a_b: the motion from b to c."""
        return self.inverse() @ T_a_c

    def log(self) -> Float[Array, "*batch 3"]:
        """Twist (v_x, v_y, omega) whose `exp` is this motion, with the yaw wrapped."""
        omega = wrap(self.yaw)
        a = _half_cotangent(omega)
        x, y = self.xy[..., 0], self.xy[..., 1]
        half = omega / 2
        return jnp.stack([a * x + half * y, a * y - half * x, omega], axis=-1)

    @staticmethod
    def exp(twist: Float[Array, "*batch 3"]) -> "SE2":
        """The motion of constant velocity (v_x, v_y, omega) over unit time: an arc."""
        velocity, omega = twist[..., :2], twist[..., 2]
        s, c = jnp.sinc(omega / jnp.pi)[..., None], _versine_ratio(omega)[..., None]
        return SE2(s * velocity + c * _quarter_turn(velocity), omega)


def _quarter_turn(vectors: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
    """Vectors turned to the left by a right angle."""
    return vectors[..., ::-1] * jnp.array([-1, 1], vectors.dtype)


def _versine_ratio(omega: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """(1 - cos omega) / omega, by its series near zero."""
    small = jnp.abs(omega) < 1e-3
    w = jnp.where(small, 1, omega)
    return jnp.where(small, omega / 2 - omega**3 / 24, (1 - jnp.cos(w)) / w)


def _half_cotangent(omega: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """(omega/2) / tan(omega/2), by its series near zero."""
    small = jnp.abs(omega) < 1e-3
    w = jnp.where(small, 1, omega)
    return jnp.where(small, 1 - omega**2 / 12, (w / 2) / jnp.tan(w / 2))
