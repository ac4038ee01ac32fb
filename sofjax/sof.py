"""Extracting SoF: two views and a motion give the segments on the floor; Fig. 5."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sofjax.association import Association, Matches, associate
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.floor import floor_homography, horizon, segment_to_floor
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.geometry.two_view import two_view_homography


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
