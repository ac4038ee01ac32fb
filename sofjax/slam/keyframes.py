"""The keyframes that stay open while driving, and what the others have left."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sofjax.geometry.se2 import SE2
from sofjax.likelihood.measurements import Measurements
from sofjax.motion import OdometerBias
from sofjax.slam.config import FixedLagConfig


class Keyframe(eqx.Module):
    """An image that stays open."""

    T_world_robot: SE2
    jitter: Float[Array, "*batch 2"]  # attitude jitter (pitch, roll), radians
    measurements: Measurements  # [*batch, M]
    motion: SE2  # since the keyframe before, as read ...
    way: Float[Array, "*batch 3"]  # ... how far that was, of `way_of`, ...
    unread: Float[Array, "*batch 3"]  # ... and the variance of what was not read of it
    trust: Float[Array, "*batch"]  # in that reading: less than 1 where the wheels may have slipped
    bias: OdometerBias  # belief of the odometer's errors at that image


class Known(eqx.Module):
    """Information on the lines from keyframes that are no longer open."""

    line: Float[Array, "K 3"]  # (rho, theta, apparent scale) about the anchor
    information: Float[Array, "K 3 3"]


class Window(eqx.Module):
    """What is carried from one image to the next."""

    keyframes: Keyframe  # [W], the latest last
    count: Int[Array, ""]  # of keyframes so far
    known: Known  # of all lines of the map
    motion: SE2  # since the latest keyframe, as read
    way: Float[Array, "3"]
    unread: Float[Array, "3"]  # variance of what was not read of it


def empty_window(config: FixedLagConfig, capacity: int, measurements: Measurements) -> Window:
    """A window before the first image.

    **Arguments:**
    - `capacity`: K of the map.
    - `measurements`: any, for their number M.
    """
    zero = SE2.identity()
    bias = OdometerBias(jnp.zeros(4), jnp.eye(4))
    none = jnp.zeros(3)
    one = Keyframe(zero, jnp.zeros(2), measurements, zero, none, none, jnp.zeros(()), bias)
    frames = jax.tree.map(lambda a: jnp.zeros((config.keyframes, *a.shape), a.dtype), one)
    known = Known(jnp.zeros((capacity, 3)), jnp.zeros((capacity, 3, 3)))
    return Window(frames, jnp.zeros((), int), known, zero, none, none)
