"""The sensor model, stated once: how well a line of the map explains an observed segment; III.A.

Both lines are in polar form (rho, theta) about the same point, and each is named from the side of
the other, so that d = (d_rho, d_theta) has no jump. The same difference is measured in three ways:

- eq. (9), association: two images, in pixels,
  epsilon = alpha |d_rho| + beta |d_theta|
- the paper's sensor model: a segment and a line of the map, on the floor,
  e = (d_rho / sigma_rho)² + (d_theta / sigma_theta)²
- the sensor model here: the same two, on the floor,
  e = dᵀ S⁻¹ d with S = S_segment + S_line

S_segment is carried from the pixels of the end points by the Jacobian of the inverse projection,
eq. (13); S_line is the map line's covariance as it appears from the pose. With constant sigmas S is
diagonal and e is the paper's. A pair counts only if segment and line overlap, and an observed
segment that explains nothing costs `e_max`, the outlier cost:

    log L = -1/2 sum over segments of min(e_max, min over lines of e)

It is evaluated in two ways, which a test holds together. `likelihood.tracking` is what a step of
the filter uses: a few candidate lines for each segment, chosen near the predicted pose, and the
image's attitude jitter solved for. `likelihood.batch` compares N poses with every line of a map,
wherever they are.
"""

from collections.abc import Sequence

import equinox as eqx
from jaxtyping import Array, Float

from sofjax._checks import check_fields

Scalar = Float[Array, ""] | float


class SensorModel(eqx.Module):
    """Gaussian noise of a segment in (rho, theta), and the outlier cost."""

    propagate: bool = eqx.field(static=True, default=True)  # False: the paper's constant sigmas
    pixel_sigma: float = 0.5  # pixels, of an end point across its segment
    tilt_sigma: float = 0.001  # radians, attitude jitter: pitch and roll from image to image
    rho_sigma: float = 0.02  # metres; the constant sigma, unused with `propagate`
    theta_sigma: float = 0.02  # radians; the constant sigma, unused with `propagate`
    upright: float = 1.0  # pixels that an upright's ends may be off a line to the nadir; 0: none
    theta_limit: float = 0.3  # radians; a segment whose direction is known less well is not used
    adaptation: float = 0.3  # share of the surplus error by which the variance inflates in a step
    noise_gate: float = 4.0  # variance inflation up to which it widens what may match; ...
    noise_max: float = 1e4  # ... up to here it only lessens the weight of the measurements
    e_max: float = 9.0  # outlier cost: of an observed segment that matches nothing

    def __check_init__(self) -> None:
        check_fields(
            self,
            at_least_zero=("tilt_sigma", "upright", "adaptation"),
            positive=("pixel_sigma", "rho_sigma", "theta_sigma", "theta_limit", "e_max"),
            at_least_one=("noise_gate", "noise_max"),
        )


class LineNoise(eqx.Module):
    """Constant noise of a segment in (rho, theta), and the outlier cost; for `log_likelihood`.

    **Arguments:**
    - `rho_sigma`, `theta_sigma`: standard deviations, metres and radians.
    - `e_max`: the cost of an observed segment that explains nothing.
    - `gap_scale`: tau, metres: how fast the soft form forgets a pair that does not overlap.
    """

    rho_sigma: Scalar
    theta_sigma: Scalar
    e_max: Scalar = 9.0
    gap_scale: Scalar = 0.05

    def __check_init__(self) -> None:
        check_fields(self, positive=("rho_sigma", "theta_sigma", "e_max", "gap_scale"))


def squared_error(W: Sequence[Array] | Array, d_rho: Array, d_theta: Array) -> Array:
    """e = dᵀ W d by the elements (rho rho, rho theta, theta theta) of W = S⁻¹.

    For a diagonal W it is the paper's (d_rho / sigma_rho)² + (d_theta / sigma_theta)².
    """
    return W[0] * d_rho**2 + 2 * W[1] * d_rho * d_theta + W[2] * d_theta**2
