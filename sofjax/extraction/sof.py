"""Extracting SoF: two views and a motion give the segments on the floor; Fig. 5."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sofjax.extraction.association import Association, Matches, associate
from sofjax.extraction.observation import Observation
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.floor import floor_homography, horizon, segment_to_floor
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.geometry.two_view import two_view_homography


class View(eqx.Module):
    """An image kept for eq. (9), and where it was taken."""

    segments_image: Segments  # [M]
    T_world_robot: SE2
    T_odometer: SE2  # the same by the odometer's readings alone


class SofExtraction(eqx.Module):
    """The second view's segments, and which of them lie on the floor."""

    segments_robot: Segments  # M segments put on the floor, metres; valid if below the horizon
    is_floor: Bool[Array, "*batch M"]  # below the horizon and associated by eq. (9)
    matches: Matches


def put_on_floor(
    camera: Camera, mount: Mount, segments_image: Segments, max_depth: Float[Array, ""] | float
) -> Segments:
    """Inverse projection of every segment into the robot frame; eqs. (12) and (13).

    **Returns:** segments in metres; valid where some part lies below the horizon and nearer than
    `max_depth` metres, clipped to that part.
    """
    H_F = floor_homography(camera, mount, SE2.identity())
    endpoints, some = jax.vmap(segment_to_floor, in_axes=(None, 0, None))(
        H_F, segments_image.endpoints, jnp.asarray(max_depth)
    )
    return Segments(endpoints, some & segments_image.valid)


def below_horizon(camera: Camera, mount: Mount, segments_image: Segments) -> Segments:
    """The same segments, valid only if both ends lie below the horizon."""
    line = horizon(floor_homography(camera, mount, SE2.identity()))
    below = segments_image.endpoints @ line[:2] + line[2] > 0
    return Segments(segments_image.endpoints, segments_image.valid & below.all(axis=-1))


def extract(
    config: Association,
    camera: Camera,
    mount: Mount,
    first: Segments,
    second: Segments,
    T_first_second: SE2,
    max_depth: Float[Array, ""] | float = 20.0,
) -> SofExtraction:
    """Steps 4 to 6 of Fig. 5 for one hypothetical motion; vmap over `T_first_second` for many.

    **Arguments:**
    - `first`, `second`: segments of the two undistorted images, pixels.
    - `T_first_second`: the robot's motion between them.
    - `max_depth`: metres; what is farther is not used.
    """
    H = two_view_homography(camera, mount, T_first_second)  # eq. (8)
    first = below_horizon(camera, mount, first)
    matches = associate(config, camera, H, first, second)  # eq. (9)
    segments_robot = put_on_floor(camera, mount, second, max_depth)  # eq. (13)
    return SofExtraction(segments_robot, matches.matched & segments_robot.valid, matches)


def view_a_baseline_away(
    config: Association, recent: View, reference: View, T_world_robot: SE2
) -> View:
    """The most recent kept view that is far enough, so that eq. (9) can tell the floor."""
    enough = _far_enough(config, recent, T_world_robot)
    return jax.tree.map(lambda a, b: jnp.where(enough, a, b), recent, reference)


def keep_views(config: Association, recent: View, reference: View, view: View) -> tuple[View, View]:
    """The two last views that were taken a baseline apart, once `view` has been."""
    first = ~recent.segments_image.valid.any()
    keep = _far_enough(config, recent, view.T_world_robot) | first
    keep = keep & view.segments_image.valid.any()  # nothing can be compared with the dark
    pick = lambda a, b: jax.tree.map(lambda x, y: jnp.where(keep, x, y), a, b)
    return pick(view, recent), pick(recent, reference)


def _far_enough(config: Association, view: View, T_world_robot: SE2) -> Bool[Array, ""]:
    motion = view.T_world_robot.between(T_world_robot)
    far = jnp.sum(motion.xy**2) >= config.baseline_distance**2
    return far | (jnp.abs(motion.yaw) >= config.baseline_angle)


@jax.jit
def extract_along(
    config: Association,
    camera: Camera,
    mount: Mount,
    log: Observation,
    max_depth: Float[Array, ""] | float = 20.0,
) -> tuple[SofExtraction, Bool[Array, "T"]]:
    """SoF of a whole log by the odometer's motion alone, each image against one a baseline before.

    **Arguments:**
    - `log`: observations with a leading axis T.

    **Returns:** the extractions with a leading axis T, and which images had one to be compared
    with.
    """

    def next_image(carry: tuple[SE2, View, View], observation: Observation) -> tuple:
        T_world_robot, recent, reference = carry
        T_world_robot = T_world_robot @ observation.motion
        view = view_a_baseline_away(config, recent, reference, T_world_robot)
        second = observation.segments_image
        found = extract(
            config, camera, mount, view.segments_image, second,
            view.T_world_robot.between(T_world_robot), max_depth,
        )  # fmt: skip
        kept = keep_views(config, recent, reference, View(second, T_world_robot, T_world_robot))
        return (T_world_robot, *kept), (found, view.segments_image.valid.any())

    start = jax.tree.map(lambda a: jnp.zeros_like(a[0]), (log.motion, log.segments_image))
    none = View(start[1], start[0], start[0])
    return jax.lax.scan(next_image, (start[0], none, none), log)[1]
