"""Pairs of measurements of one line, and their distances under a rig; eqs. (4) to (8)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax._checks import check_fields
from sofjax.geometry.lines import cofactor, line_point_distance, line_through
from sofjax.geometry.se2 import SE2
from sofjax.geometry.two_view import two_view_homography
from sofjax.motion import BIAS, MotionModel, read_twist, way_of
from sofjax.rig import RIG, RIG_MOUNT, Rig, motion_between, retaken

UNKNOWNS = (*RIG, *BIAS)
U = len(UNKNOWNS)
MOUNT = UNKNOWNS[:4]
ODOMETER = slice(len(RIG), None)  # of UNKNOWNS
TURNS = BIAS[1:]  # an odometer's largest errors: always free beside a mount


class SegmentPairs(eqx.Module):
    """N pairs of segments, each two measurements of one line of the floor."""

    first: Float[Array, "*N 2 2"]  # end points in the first image, pixels, undistorted
    second: Float[Array, "*N 2 2"]  # end points in the second
    T_first_second: SE2  # [N] the robot's motion between them, as the odometer read it
    valid: Bool[Array, "*N"]
    sigma: Float[Array, "*N 4"]  # standard deviations of the distances, pixels; see `expected`
    cluster: Int[Array, "*N"]  # errors of pairs with one number may be correlated; 0 to N - 1
    # `Observation.around` of the two images; without it clock and shutter are not observable
    around: tuple[Float[Array, "*N L 3"], Float[Array, "*N L 3"]] | None = None


class Estimate(eqx.Module):
    """A rig other than it was given by small corrections, and the odometer's systematic errors."""

    given: Rig
    by: Float[Array, "17"]  # of each of UNKNOWNS, in the units of `RIG` and of `MotionModel`

    def moved(self, by: Float[Array, "17"]) -> "Estimate":
        """Changed by so much more."""
        return Estimate(self.given, self.by + by)

    @property
    def rig(self) -> Rig:
        return self.given.moved(self.by[: len(RIG)])

    @property
    def bias(self) -> Float[Array, "4"]:
        return self.by[ODOMETER]

    def motion(self, read: SE2) -> SE2:
        """The motion of the robot where the odometer read `read`, a short motion."""
        return SE2.exp(read_twist(read, way_of(read), self.bias))


def start_at(given: Rig) -> Estimate:
    """The rig as it was given, and an odometer without systematic errors."""
    return Estimate(given, jnp.zeros(U, jnp.result_type(given.mount.height)))


class Seen(eqx.Module):
    """A pair as the estimated rig would have seen it, all rows at the stamp."""

    first: Float[Array, "*N 2 2"]  # pixels
    second: Float[Array, "*N 2 2"]
    T_first_second: SE2  # as the odometer read it between the true moments

    def moved(self, by: Float[Array, "*N 11"]) -> "Seen":
        """With the end points moved by pixels, and the motion by a twist."""
        shape = self.first.shape
        T = self.T_first_second @ SE2.exp(by[..., 8:])
        return Seen(
            self.first + by[..., :4].reshape(shape), self.second + by[..., 4:8].reshape(shape), T
        )


def seen_by(estimate: Estimate, pair: SegmentPairs) -> Seen:
    """One pair, as the estimated rig would have seen it."""
    given, rig = estimate.given, estimate.rig
    around = pair.around or (None, None)
    first, second = (
        jax.vmap(retaken, in_axes=(None, None, None, 0))(given, rig, moments, ends)
        for ends, moments in ((pair.first, around[0]), (pair.second, around[1]))
    )
    read = pair.T_first_second
    if pair.around is not None:
        read = motion_between(given, rig, read, *pair.around)
    return Seen(first, second, read)


def seen_near(estimate: Estimate, pair: SegmentPairs) -> tuple[Seen, Float[Array, "11 17"]]:
    """One pair as seen, and how that changes with the estimate, by `Seen.moved`: to first order."""
    at = seen_by(estimate, pair)
    lens_on = slice(len(RIG_MOUNT), len(RIG))  # of the mount nearly nothing depends here

    def off(by: Float[Array, "7"]) -> Float[Array, "11"]:
        other = seen_by(estimate.moved(jnp.zeros(U, by.dtype).at[lens_on].set(by)), pair)
        moved = at.T_first_second.between(other.T_first_second).log()
        return jnp.concatenate([
            (other.first - at.first).ravel(), (other.second - at.second).ravel(), moved,
        ])  # fmt: skip

    J = jax.jacfwd(off)(jnp.zeros_like(estimate.by[lens_on]))
    return at, jnp.zeros((11, U), J.dtype).at[:, lens_on].set(J)


def distances(estimate: Estimate, seen: Seen) -> Float[Array, "4"]:
    """Distances of each segment's ends from the other's line, which H transfers over the floor.

    Eqs. (4) to (8), symmetric: the ends of the second from l'' = H^-T l, then those of the first
    from Hᵀ l'.

    **Arguments:**
    - `seen`: one pair.

    **Returns:** pixels, signed; zero for a line of the floor if the estimate is right.
    """
    rig = estimate.rig
    T = estimate.motion(seen.T_first_second)
    H = two_view_homography(rig.camera, rig.mount, T)  # eq. (8)
    l_second = cofactor(H) @ line_through(*seen.first)
    l_first = H.T @ line_through(*seen.second)
    to = jax.vmap(line_point_distance, in_axes=(None, 0))
    return jnp.concatenate([to(l_second, seen.second), to(l_first, seen.first)])


def all_distances(estimate: Estimate, pairs: SegmentPairs) -> Float[Array, "N 4"]:
    """`distances` of all pairs, valid or not."""
    return jax.vmap(lambda pair: distances(estimate, seen_by(estimate, pair)))(pairs)


class PairNoise(eqx.Module):
    """Residual noise of correct pairs, with an exact mount."""

    pixel_sigma: float = 0.5  # pixels, of an end point across its segment
    odometer: MotionModel = MotionModel()  # its noise, and the priors of its errors in turning

    def __check_init__(self) -> None:
        check_fields(self, at_least_zero=("pixel_sigma",))


@eqx.filter_jit
def expected(noise: PairNoise, estimate: Estimate, pairs: SegmentPairs) -> Float[Array, "N 4"]:
    """Standard deviations of the distances, pixels.

    Noise of all four end points, and of the odometer between the images, propagated by the
    Jacobian of `distances`. They stay fixed in a fit: otherwise it could lower its cost by larger
    standard deviations.
    """
    model = noise.odometer

    def one(pair: SegmentPairs) -> Float[Array, "4"]:
        seen = seen_by(estimate, pair)
        twist = seen.T_first_second.log()
        by = jax.jacfwd(
            lambda first, second, twist: distances(estimate, Seen(first, second, SE2.exp(twist))),
            argnums=(0, 1, 2),
        )(seen.first, seen.second, twist)
        length, turn = jnp.abs(twist[0]), jnp.abs(twist[2])
        moved = jnp.stack([
            model.distance_noise**2 * length,
            model.lateral_noise**2 * length,
            model.heading_noise**2 * length + model.turn_noise**2 * turn
            + (model.turn_scale_sigma * turn) ** 2 + (model.curvature_sigma * length) ** 2,
        ])  # fmt: skip
        seen = jnp.sum(by[0] ** 2, axis=(1, 2)) + jnp.sum(by[1] ** 2, axis=(1, 2))
        return jnp.sqrt(noise.pixel_sigma**2 * seen + by[2] ** 2 @ moved)

    return jax.vmap(one)(pairs)
