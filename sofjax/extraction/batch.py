"""Two views of the floor under N hypothetical motions: eqs. (8) and (9), and the lines between."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sofjax.extraction.association import Association, association_error
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.lines import line_through, transfer_line
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.geometry.two_view import two_view_homography


@jax.jit
def homographies(camera: Camera, mount: Mount, T_first_second: SE2) -> Float[Array, "N 3 3"]:
    """The homography that the floor induces between two images, for N motions; eq. (8).

    **Arguments:**
    - `camera`, `mount`: pixels; metres and radians.
    - `T_first_second`: N motions of the robot between the images. From poses of the second image
      in the world they are `T_world_first.between(T_world_second)`.

    **Returns:** H with x' ~ H x, pixels; each equal to `two_view_homography`.
    """
    return jax.vmap(two_view_homography, in_axes=(None, None, 0))(camera, mount, T_first_second)


@jax.jit
def transferred_lines(H: Float[Array, "N 3 3"], first: Segments) -> Float[Array, "N M 3"]:
    """l'' ~ H^-T l, the lines of M segments of the first image as N homographies move them.

    **Arguments:**
    - `H`: N homographies from the first image to the second.
    - `first`: M segments, pixels.

    **Returns:** homogeneous lines of the second image, up to scale; zero where a segment has no
    length or is not valid.
    """
    lines = jax.vmap(lambda ends: line_through(*ends))(first.endpoints)
    lines = jnp.where(first.valid[:, None], lines, 0)
    return jax.vmap(jax.vmap(transfer_line, in_axes=(None, 0)), in_axes=(0, None))(H, lines)


@jax.jit
def association_scores(
    config: Association,
    camera: Camera,
    H: Float[Array, "N 3 3"],
    first: Segments,
    second: Segments,
) -> Float[Array, "N M1 M2"]:
    """epsilon of eq. (9) of every pair of segments under N homographies.

    **Arguments:**
    - `config`: alpha and beta.
    - `H`: N homographies of the floor from the first image to the second.
    - `first`, `second`: M and M' segments, pixels.

    **Returns:** `association_error` of each pair; inf where a pair does not overlap, has left the
    view or is padding. The lines are transferred once for (n, m), not once for every pair.
    """
    one = lambda H, a, b: association_error(config, camera, H, a, b)
    over_second = jax.vmap(one, in_axes=(None, None, 0))
    over_first = jax.vmap(over_second, in_axes=(None, 0, None))
    scores = jax.vmap(over_first, in_axes=(0, None, None))(H, first.endpoints, second.endpoints)
    return jnp.where(first.valid[:, None] & second.valid, scores, jnp.inf)
