"""Which segments of two images show the same line on the floor; eq. (9) for all pairs."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax._checks import check_fields
from sofjax.geometry.camera import Camera
from sofjax.geometry.lines import line_through, polar, polar_differences, transfer_line
from sofjax.geometry.segments import Segments, overlap
from sofjax.geometry.two_view import transfer_segment


class Association(eqx.Module):
    """Settings of eq. (9) and of the pair of views that it compares."""

    alpha: float = 1.0  # weight of |rho' - rho''|, 1 / pixel
    beta: float = 60.0  # weight of |theta' - theta''|, 1 / radian
    gate: float = 6.0  # Theta: epsilon must be below it
    temperature: float = 1.0  # of the gate of the soft filter, in units of epsilon
    baseline_distance: float = 0.15  # camera heights between the two views, or ...
    baseline_angle: float = 0.15  # ... radians, whichever comes first

    def __check_init__(self) -> None:
        check_fields(
            self,
            positive=("temperature",),
            at_least_zero=("alpha", "beta", "gate", "baseline_distance", "baseline_angle"),
        )


class Matches(eqx.Module):
    """For each segment of the second image, its best partner in the first."""

    error: Float[Array, "*batch M2"]  # epsilon of eq. (9); inf where there is no candidate
    partner: Int[Array, "*batch M2"]  # index into the first image's segments
    matched: Bool[Array, "*batch M2"]


def association_error(
    config: Association,
    camera: Camera,
    H: Float[Array, "3 3"],
    first: Float[Array, "2 2"],
    second: Float[Array, "2 2"],
) -> Float[Array, ""]:
    """epsilon = alpha |rho' - rho''| + beta |theta' - theta''| of one pair of segments; eq. (9).

    Differs from the paper: its errors are signed and could cancel. The polar form is taken about
    the principal point: about the image's corner an error in theta becomes a large one in rho.

    **Arguments:**
    - `H`: homography of the floor from the first image to the second.
    - `first`, `second`: end points, pixels.

    **Returns:** epsilon; inf if l'' and l' do not overlap in the second image, or if the first
    segment has left the view.
    """
    centre = camera.K[:2, 2]
    to_centre = jnp.eye(3).at[:2, 2].set(-centre)
    H_centred = to_centre @ H @ jnp.linalg.inv(to_centre)
    moved, ahead = transfer_segment(H_centred, first - centre)
    l2 = polar(transfer_line(H_centred, line_through(*(first - centre))))  # l'' = H^-T l
    l1 = polar(line_through(*(second - centre)))  # l'
    d_rho, d_theta = polar_differences(l1, l2)
    error = config.alpha * jnp.abs(d_rho) + config.beta * jnp.abs(d_theta)
    return jnp.where(ahead & (overlap(moved, second - centre) > 0), error, jnp.inf)


def associate(
    config: Association,
    camera: Camera,
    H: Float[Array, "3 3"],
    first: Segments,
    second: Segments,
) -> Matches:
    """Best partner in the first image of every segment in the second, gated by Theta.

    **Arguments:**
    - `H`: homography of the floor from the first image to the second.
    - `first`, `second`: M1 and M2 segments, pixels.
    """
    over_first = jax.vmap(association_error, in_axes=(None, None, None, 0, None))
    errors = jax.vmap(over_first, in_axes=(None, None, None, None, 0))(
        config, camera, H, first.endpoints, second.endpoints
    )
    errors = jnp.where(first.valid & second.valid[:, None], errors, jnp.inf)
    error = errors.min(axis=1)
    return Matches(error, errors.argmin(axis=1), error < config.gate)


def gate_probability(config: Association, error: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The gate of eq. (9) as one that opens slowly: 1 / (1 + exp((epsilon - Theta) / T)).

    Zero where there is no candidate; with the derivatives by alpha, beta and Theta that a gate
    which is open or shut does not have.
    """
    some = jnp.isfinite(error)
    open_by = (config.gate - jnp.where(some, error, 0)) / config.temperature
    return jnp.where(some, jax.nn.sigmoid(open_by), 0)
