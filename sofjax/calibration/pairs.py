"""Two measurements of one line, a baseline apart, and how well the mount makes them agree."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.lines import cofactor, line_point_distance, line_through
from sofjax.geometry.se2 import SE2
from sofjax.geometry.two_view import two_view_homography
from sofjax.motion import MotionModel

UNKNOWNS = ("height", "pitch", "roll", "yaw", "distance", "left", "right", "curvature")
U = len(UNKNOWNS)
TURNS = UNKNOWNS[5:]  # an odometer errs in these more than in anything: free with any mount


class Pairs(eqx.Module):
    """N pairs of segments that are taken for the same line of the floor."""

    first: Float[Array, "N 2 2"]  # end points in the first image, pixels, undistorted
    second: Float[Array, "N 2 2"]  # end points in the second
    T_first_second: SE2  # [N] the robot's motion between them, as the odometer read it
    valid: Bool[Array, "N"]
    sigma: Float[Array, "N 4"]  # standard deviations of the distances, pixels; see `expected`
    cluster: Int[Array, "N"]  # pairs of one number may err together; from 0 to N - 1


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
        """What the robot did where the odometer read this, a short motion."""
        forward, sideways, turn = read.log()
        b = self.bias
        scaled = turn + jnp.maximum(turn, 0) * b[1] + jnp.minimum(turn, 0) * b[2]
        return SE2.exp(
            jnp.stack([forward * (1 + b[0]), sideways, scaled + jnp.abs(forward) * b[3]])
        )


def start_at(mount: Mount) -> Estimate:
    """A mount, and an odometer that is right."""
    return Estimate(mount, jnp.zeros(4, jnp.result_type(mount.height)))


def distances(
    camera: Camera,
    estimate: Estimate,
    first: Float[Array, "2 2"],
    second: Float[Array, "2 2"],
    T_first_second: SE2,
) -> Float[Array, "4"]:
    """How far each segment's ends lie from the other's line, carried over by the floor.

    Eqs. (4) to (8), symmetric: the ends of the second from l'' = H^-T l, then those of the first
    from Hᵀ l'.

    **Returns:** pixels, signed; zero for a line of the floor if the mount is right.
    """
    H = two_view_homography(camera, estimate.mount, estimate.motion(T_first_second))  # eq. (8)
    l_second = cofactor(H) @ line_through(*first)
    l_first = H.T @ line_through(*second)
    to = jax.vmap(line_point_distance, in_axes=(None, 0))
    return jnp.concatenate([to(l_second, second), to(l_first, first)])


def all_distances(camera: Camera, estimate: Estimate, pairs: Pairs) -> Float[Array, "N 4"]:
    """`distances` of all pairs, valid or not."""
    return jax.vmap(distances, in_axes=(None, None, 0, 0, 0))(
        camera, estimate, pairs.first, pairs.second, pairs.T_first_second
    )


class PairNoise(eqx.Module):
    """What makes true pairs miss each other, about an exact mount."""

    pixel_sigma: float = 0.5  # pixels, of an end point across its segment
    odometer: MotionModel = MotionModel()  # its noise, and the priors of its errors in turning


@eqx.filter_jit
def expected(
    noise: PairNoise, camera: Camera, estimate: Estimate, pairs: Pairs
) -> Float[Array, "N 4"]:
    """Standard deviations of the distances: a short segment far off says little of a long line.

    Noise of all four end points, and of the odometer between the images, carried through the
    residual's own Jacobian. Held fixed in a fit: a fit must not widen what it is judged by.
    """
    model = noise.odometer

    def one(first, second, T):
        def of(first, second, twist):
            return distances(camera, estimate, first, second, SE2.exp(twist))

        twist = T.log()
        by = jax.jacfwd(of, argnums=(0, 1, 2))(first, second, twist)
        way, turn = jnp.abs(twist[0]), jnp.abs(twist[2])
        moved = jnp.stack([
            model.distance_noise**2 * way,
            model.lateral_noise**2 * way,
            model.heading_noise**2 * way + model.turn_noise**2 * turn
            + (model.turn_scale_sigma * turn) ** 2 + (model.curvature_sigma * way) ** 2,
        ])  # fmt: skip
        seen = jnp.sum(by[0] ** 2, axis=(1, 2)) + jnp.sum(by[1] ** 2, axis=(1, 2))
        return jnp.sqrt(noise.pixel_sigma**2 * seen + by[2] ** 2 @ moved)

    return jax.vmap(one)(pairs.first, pairs.second, pairs.T_first_second)
