"""From images and odometry to what the filter takes."""

from collections.abc import Callable, Iterable

import jax
import jax.numpy as jnp
import numpy as np

from sofjax.geometry import SE2
from sofjax.io.drive import Drive, motions
from sofjax.observation import Observation
from sofjax.vision.frontend import Frontend, View


def observation(view: View, motion: np.ndarray) -> Observation:
    """One image's observation.

    **Arguments:**
    - `view`: the image's segments.
    - `motion`: [3], T_previous_current of the odometer as (dx, dy, dyaw), metres and radians.
    """
    return Observation(
        segments_image=view.segments_image,
        motion=SE2(jnp.asarray(motion[:2], float), jnp.asarray(motion[2], float)),
        overflow=jnp.asarray(view.overflow, int),
    )


def observe_drive(
    drive: Drive, frontend: Frontend, progress: Callable[[Iterable], Iterable] = iter
) -> Observation:
    """A whole drive with a leading axis T: detected once, replayed as often as one likes.

    An image that cannot be read is one without segments. `progress` wraps the loop over the images.
    """
    each = [
        observation(frontend.view(file), motion)
        for file, motion in zip(progress(drive.image_files), motions(drive), strict=True)
    ]
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *each)
