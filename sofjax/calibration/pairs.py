"""Pairs of measurements of one line, and their distances under a mount; eqs. (4) to (8)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax._checks import check_fields
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.lines import cofactor, line_point_distance, line_through
from sofjax.geometry.se2 import SE2
from sofjax.geometry.two_view import two_view_homography
from sofjax.motion import MotionModel

UNKNOWNS = ("height", "pitch", "roll", "yaw", "distance", "left", "right", "curvature")
U = len(UNKNOWNS)
TURNS = UNKNOWNS[5:]  # an odometer's largest errors: always free beside a mount


class SegmentPairs(eqx.Module):
    """N pairs of segments, each two measurements of one line of the floor."""

    first: Float[Array, "N 2 2"]  # end points in the first image, pixels, undistorted
    second: Float[Array, "N 2 2"]  # end points in the second
    T_first_second: SE2  # [N] the robot's motion between them, as the odometer read it
    valid: Bool[Array, "N"]
    sigma: Float[Array, "N 4"]  # standard deviations of the distances, pixels; see `expected`
    cluster: Int[Array, "N"]  # errors of pairs with one number may be correlated; 0 to N - 1


class Estimate(eqx.Module):
    """A mount, and the odometer's systematic errors b, those of `MotionModel`."""

    mount: Mount
    bias: Float[Array, "4"]  # of distance, of left and of right turns, shares; radians per metre

    def moved(self, by: Float[Array, "8"]) -> "Estimate":
        """Changed by log height, pitch, roll, yaw, and b."""
        m = self.mount
        mount = Mount(
            m.x, m.y, m.height * jnp.exp(by[0]), m.pitch + by[1], m.roll + by[2], m.yaw + by[3]
        )
        return Estimate(mount, self.bias + by[4:])

    def motion(self, read: SE2) -> SE2:
        """The motion of the robot where the odometer read `read`, a short motion."""
        forward, sideways, turn = read.log()
        b = self.bias
        scaled = turn + jnp.maximum(turn, 0) * b[1] + jnp.minimum(turn, 0) * b[2]
        return SE2.exp(
            jnp.stack([forward * (1 + b[0]), sideways, scaled + jnp.abs(forward) * b[3]])
        )


def start_at(mount: Mount) -> Estimate:
    """The estimate of this mount and an odometer without systematic errors."""
    return Estimate(mount, jnp.zeros(4, jnp.result_type(mount.height)))


def distances(
    camera: Camera,
    estimate: Estimate,
    first: Float[Array, "2 2"],
    second: Float[Array, "2 2"],
    T_first_second: SE2,
) -> Float[Array, "4"]:
    """Distances of each segment's ends from the other's line, which H transfers over the floor.

    Eqs. (4) to (8), symmetric: the ends of the second from l'' = H^-T l, then those of the first
    from Hᵀ l'.

    **Returns:** pixels, signed; zero for a line of the floor if the mount is right.
    """
    H = two_view_homography(camera, estimate.mount, estimate.motion(T_first_second))  # eq. (8)
    l_second = cofactor(H) @ line_through(*first)
    l_first = H.T @ line_through(*second)
    to = jax.vmap(line_point_distance, in_axes=(None, 0))
    return jnp.concatenate([to(l_second, second), to(l_first, first)])


def all_distances(camera: Camera, estimate: Estimate, pairs: SegmentPairs) -> Float[Array, "N 4"]:
    """`distances` of all pairs, valid or not."""
    return jax.vmap(distances, in_axes=(None, None, 0, 0, 0))(
        camera, estimate, pairs.first, pairs.second, pairs.T_first_second
    )


class PairNoise(eqx.Module):
    """Residual noise of correct pairs, with an exact mount."""

    pixel_sigma: float = 0.5  # pixels, of an end point across its segment
    odometer: MotionModel = MotionModel()  # its noise, and the priors of its errors in turning

    def __check_init__(self) -> None:
        check_fields(self, at_least_zero=("pixel_sigma",))


@eqx.filter_jit
def expected(
    noise: PairNoise, camera: Camera, estimate: Estimate, pairs: SegmentPairs
) -> Float[Array, "N 4"]:
    """Standard deviations of the distances, pixels.

    Noise of all four end points, and of the odometer between the images, propagated by the
    Jacobian of `distances`. They stay fixed in a fit: otherwise it could lower its cost by larger
    standard deviations.
    """
    model = noise.odometer

    def one(first: Float[Array, "2 2"], second: Float[Array, "2 2"], T: SE2) -> Float[Array, "4"]:
        def of(
            first: Float[Array, "2 2"], second: Float[Array, "2 2"], twist: Float[Array, "3"]
        ) -> Float[Array, "4"]:
            return distances(camera, estimate, first, second, SE2.exp(twist))

        twist = T.log()
        by = jax.jacfwd(of, argnums=(0, 1, 2))(first, second, twist)
        length, turn = jnp.abs(twist[0]), jnp.abs(twist[2])
        moved = jnp.stack([
            model.distance_noise**2 * length,
            model.lateral_noise**2 * length,
            model.heading_noise**2 * length + model.turn_noise**2 * turn
            + (model.turn_scale_sigma * turn) ** 2 + (model.curvature_sigma * length) ** 2,
        ])  # fmt: skip
        seen = jnp.sum(by[0] ** 2, axis=(1, 2)) + jnp.sum(by[1] ** 2, axis=(1, 2))
        return jnp.sqrt(noise.pixel_sigma**2 * seen + by[2] ** 2 @ moved)

    return jax.vmap(one)(pairs.first, pairs.second, pairs.T_first_second)
