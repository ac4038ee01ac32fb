"""Whether the images show the motion that the wheels read: two witnesses, compared by eq. (9).

Images that tell nothing of the motion, or that tell of another one for longer than a slip of the
wheels lasts, are not used, and what they did since they last confirmed a turn is taken back: the
estimate is the odometer's.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sofjax.geometry.se2 import SE2
from sofjax.motion import read_twist, way_of
from sofjax.particles import mean_bias, mean_pose
from sofjax.slam.config import Setup
from sofjax.slam.extract import Extracted, sof_from
from sofjax.slam.predict import Predicted
from sofjax.slam.state import Consistency, SlamState

BESIDE = 0.3  # radians beside the motion, where a segment finds partners by chance only
SURE = 3.0  # standard deviations by which more segments move as read than by chance
KEPT = 0.9  # of the counts, from image to image: a memory of ten images
CONTRADICTED = 0.1  # of the segments: so many more stand still than move as read
AGREED = 0.03  # the same, below which an image agrees again
FEW = 36.0  # segments compared: fewer tell nothing
TURNED = 0.1  # radians between the two views; straight on, other drives look alike


def consistency(
    setup: Setup, state: SlamState, predicted: Predicted, extracted: Extracted
) -> Consistency:
    """What is known of the two witnesses with another image.

    The motion is the odometer's as read, without what was learned of its errors from the images.
    """
    before = state.consistency
    T_odometer = before.T_odometer @ predicted.odometer
    motion = extracted.view.T_odometer.between(T_odometer)
    compared = extracted.view.segments_image.valid.any() & (predicted.unread_sigma == 0).all()
    image = _counts(setup, extracted, motion)
    counts = jnp.where(compared, KEPT * before.counts + image, before.counts)
    seen, as_read, by_chance, still = counts
    told = as_read - by_chance > SURE * jnp.sqrt(as_read + by_chance)
    contradiction = (still - as_read) / jnp.maximum(seen, 1)
    agrees = told & (contradiction < jnp.where(before.trusted, CONTRADICTED, AGREED))
    agrees = agrees | (seen < FEW)  # until some are compared, nothing is contradicted
    wait = jnp.where(agrees, jnp.maximum(before.wait - 1, 0), before.wait)
    trusted = agrees & (wait == 0)
    given_up = before.trusted & ~trusted
    wait = jnp.where(given_up, before.next_wait, wait)
    next_wait = jnp.where(given_up, 2 * before.next_wait, before.next_wait)

    confirmed = trusted & (contradiction < AGREED) & (jnp.abs(motion.yaw) > TURNED)
    read = read_twist(predicted.odometer, way_of(predicted.odometer), before.bias)
    T_world_robot, bias = jax.tree.map(
        lambda now, since: jnp.where(confirmed, now, since),
        (predicted.T_world_robot, mean_bias(predicted.particles)),
        (before.T_world_robot @ SE2.exp(read), before.bias),
    )
    return Consistency(counts, trusted, wait, next_wait, T_odometer, T_world_robot, bias)


def _counts(setup: Setup, extracted: Extracted, motion: SE2) -> Float[Array, "4"]:
    """Segments of an image: all, those that moved as read, by chance as many, and still ones."""
    view, segments_image = extracted.view, extracted.segments_image
    beside = SE2(jnp.zeros(2), jnp.where(motion.yaw > 0, -BESIDE, BESIDE))
    of = lambda moved: sof_from(
        setup, view, segments_image, view.T_world_robot @ moved
    ).is_floor.sum()
    counts = (extracted.seen.sum(), of(motion), of(motion @ beside), of(SE2.identity()))
    return jnp.stack(counts).astype(float)


def doubt(
    setup: Setup, state: SlamState, predicted: Predicted, extracted: Extracted
) -> tuple[Predicted, Extracted]:
    """No segment is used of an image that is not trusted; what is given up is taken back."""
    before, after = state.consistency, consistency(setup, state, predicted, extracted)
    extracted = eqx.tree_at(
        lambda e: (e.measurements.valid, e.consistency), extracted,
        (extracted.measurements.valid & after.trusted, after),
    )  # fmt: skip
    given_up = before.trusted & ~after.trusted
    particles, unslipped = (
        jax.tree.map(
            lambda back, here: jnp.where(given_up, back, here),
            each.moved_to(after.T_world_robot, after.bias), each,
        )
        for each in (predicted.particles, predicted.unslipped)
    )  # fmt: skip
    predicted = eqx.tree_at(
        lambda p: (p.particles, p.unslipped, p.T_world_robot), predicted,
        (particles, unslipped, mean_pose(particles)),
    )  # fmt: skip
    return predicted, extracted


def through_unread(
    state: SlamState, predicted: Predicted, extracted: Extracted, T_world_robot: SE2
) -> Extracted:
    """Where the odometer told nothing, its path goes on by the estimate's motion."""
    before, after = state.consistency, extracted.consistency
    motion = mean_pose(state.particles).between(T_world_robot)
    unread = (predicted.unread_sigma > 0).any()
    paths = jax.tree.map(
        lambda by_estimate, as_read: jnp.where(unread, by_estimate, as_read),
        (before.T_odometer @ motion, before.T_world_robot @ motion),
        (after.T_odometer, after.T_world_robot),
    )
    return eqx.tree_at(
        lambda e: (e.consistency.T_odometer, e.consistency.T_world_robot), extracted, paths
    )
