"""The paper's closing: the mismatch of the end, spread evenly backward along the path."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sofjax.geometry.se2 import SE2


def distribute(
    T_world_robot: SE2, travelled: Float[Array, "n"], T_correction: SE2
) -> tuple[SE2, SE2]:
    """Turn and shift each pose by its share of the way of what the last one is off by.

    **Arguments:**
    - `T_world_robot`: [n] the path from the place first seen to the place seen again.
    - `travelled`: metres driven up to each pose; does not decrease.
    - `T_correction`: in the world: applied to the last pose it puts it where it should be.

    **Returns:** the path, and for each pose the motion [n] of the world's points about it: what was
    seen from there moves with it.
    """
    way = travelled - travelled[0]
    share = way / jnp.where(way[-1] > 0, way[-1], 1)
    last = jax.tree.map(lambda a: a[-1], T_world_robot)
    target = T_correction @ last
    # a heading that errs evenly along the way bends the path; what is left of the gap is shifted
    turn = share * T_correction.yaw
    steps = jax.tree.map(lambda a: a[:-1], T_world_robot).between(
        jax.tree.map(lambda a: a[1:], T_world_robot)
    )
    yaw = T_world_robot.yaw + turn
    moves = SE2(jnp.zeros_like(steps.xy), yaw[:-1]).rotate(steps.xy)
    bent = jnp.concatenate([T_world_robot.xy[:1], T_world_robot.xy[:1] + jnp.cumsum(moves, axis=0)])
    xy = bent + share[:, None] * (target.xy - bent[-1])
    moved = SE2(xy, yaw)
    return moved, moved @ T_world_robot.inverse()
