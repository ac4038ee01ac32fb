"""What the robot gives the filter at each image."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments

LAGS = np.linspace(-0.35, 0.35, 15)  # seconds after an image at which the odometer is looked up


class Observation(eqx.Module):
    """One image's segments and the odometer's motion since the image before.

    A log of T images is one `Observation` whose leaves carry a leading axis T.
    """

    segments_image: Segments  # capacity M, pixels of the undistorted image
    motion: SE2  # T_previous_current as the odometer reads it; the identity at the first image
    overflow: Int[Array, "*batch"]  # segments that were detected and did not fit into M
    # standard deviation of what the odometer does not tell of the motion (forward, sideways, turn),
    # beyond its noise: metres and radians; None if it tells all of it
    motion_sigma: Float[Array, "*batch 3"] | None = None
    # the odometer's way from the image to each of LAGS, as twists (v_x, v_y, omega) over it: by it
    # an image's stamp may be wrong; None if that is not known
    around: Float[Array, "*batch L 3"] | None = None
