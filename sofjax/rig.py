"""The rig: a camera, its lens, its mount and its clock, and what of them may be a little wrong.

Segments are detected in images that were undistorted by the given lens, at the given stamps. Where
the rig is another one than it was given as, the same pixels mean other rays, and other moments:
`retaken` says where they would lie had the right rig taken the image, all rows at once.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sofjax.extraction.observation import LAGS, Observation
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.matrices import inverse_2x2
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.geometry.two_view import two_view_homography

# log height; pitch, roll, yaw in radians; x, y in camera heights; log focal length; principal point
# in focal lengths; the lens's first two coefficients; seconds, and seconds a row
RIG: tuple[str, ...] = (
    "height", "pitch", "roll", "yaw", "x", "y", "focal", "cx", "cy", "k1", "k2",
    "time_offset", "line_delay",
)  # fmt: skip
RIG_MOUNT, INTRINSICS = RIG[:6], RIG[6:11]
ROUNDS = 3  # of Newton's method; a lens that is a little other is nearly linear


class Lens(eqx.Module):
    """Distortion as OpenCV has it: Brown's with a rational part, or the fisheye's."""

    coefficients: Float[Array, "8"]  # k1 k2 p1 p2 k3 k4 k5 k6; of a fisheye k1 k2 k3 k4 of theta
    fisheye: bool = eqx.field(static=True, default=False)

    @classmethod
    def of(cls, coefficients: Float[np.ndarray, "n"], fisheye: bool = False) -> "Lens":
        """A lens by the coefficients of its model; thin prisms and a tilt are left out."""
        used = np.asarray(coefficients, float)[:8]
        return cls(jnp.asarray(np.pad(used, (0, 8 - len(used))), float), fisheye)

    def distort(self, n: Float[Array, "2"]) -> Float[Array, "2"]:
        """Normalised image coordinates as this lens shows them."""
        k = self.coefficients
        x, y = n
        r2 = x * x + y * y
        if self.fisheye:
            some = r2 > 1e-12
            r = jnp.sqrt(jnp.where(some, r2, 1.0))
            theta = jnp.arctan(r)
            t2 = theta * theta
            bent = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
            return n * jnp.where(some, bent / r, 1.0)
        radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (
            1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
        )
        tangential = jnp.stack([
            2 * k[2] * x * y + k[3] * (r2 + 2 * x * x),
            k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y,
        ])  # fmt: skip
        return radial * n + tangential

    def undistort(self, d: Float[Array, "2"], near: Float[Array, "2"]) -> Float[Array, "2"]:
        """The inverse of `distort`, by Newton's method from a point that is near it."""

        def newton(n: Float[Array, "2"]) -> Float[Array, "2"]:
            J = jax.jacfwd(self.distort)(n)
            return n - inverse_2x2(J) @ (self.distort(n) - d)

        for _ in range(ROUNDS):
            near = newton(near)
        return near


class Rig(eqx.Module):
    """One camera on a robot whose odometer has another clock."""

    camera: Camera
    mount: Mount
    lens: Lens = dataclasses.field(default_factory=lambda: Lens(jnp.zeros(8)))
    time_offset: Float[Array, ""] = dataclasses.field(default_factory=lambda: jnp.zeros(()))
    line_delay: Float[Array, ""] = dataclasses.field(default_factory=lambda: jnp.zeros(()))

    def moved(self, by: Float[Array, "13"]) -> "Rig":
        """This rig, other by so much of each of `RIG`."""
        m, K = self.mount, self.camera.K
        height = m.height * jnp.exp(by[0])
        mount = Mount(
            m.x + by[4] * height, m.y + by[5] * height, height,
            m.pitch + by[1], m.roll + by[2], m.yaw + by[3],
        )  # fmt: skip
        focal = jnp.exp(by[6])
        K = K.at[0, 0].multiply(focal).at[1, 1].multiply(focal)
        K = K.at[0, 2].add(by[7] * K[0, 0]).at[1, 2].add(by[8] * K[1, 1])
        camera = Camera(K, self.camera.width, self.camera.height)
        lens = Lens(self.lens.coefficients.at[:2].add(by[9:11]), self.lens.fisheye)
        return Rig(camera, mount, lens, self.time_offset + by[11], self.line_delay + by[12])


def exposure(around: Float[Array, "L 3"], seconds: Float[Array, ""]) -> SE2:
    """The motion from the stamp to a moment after it, of what the odometer read around it.

    Beyond the first and the last of `LAGS` it is that to the first or the last.
    """
    step = LAGS[1] - LAGS[0]
    at = jnp.clip((seconds - LAGS[0]) / step, 0, len(LAGS) - 1)
    i = jnp.clip(at.astype(int), 0, len(LAGS) - 2)
    share = at - i.astype(at.dtype)
    return SE2.exp((1 - share) * around[i] + share * around[i + 1])


def motion_between(
    given: Rig,
    rig: Rig,
    T_first_second: SE2,
    first: Float[Array, "L 3"],
    second: Float[Array, "L 3"],
) -> SE2:
    """The odometer's motion between two images, by the right rig's clock.

    **Arguments:**
    - `T_first_second`: as read between the stamps, by the given rig's clock.
    - `first`, `second`: `Observation.around` of the two images.
    """
    late = rig.time_offset - given.time_offset
    return exposure(first, late).inverse() @ T_first_second @ exposure(second, late)


def retaken(
    given: Rig, rig: Rig, around: Float[Array, "L 3"] | None, point: Float[Array, "2"]
) -> Float[Array, "2"]:
    """Where a floor point would be seen, had `rig`'s camera taken all rows at the stamp.

    **Arguments:**
    - `given`: with whose lens the image was undistorted.
    - `rig`: the right one.
    - `around`: `Observation.around` of the image; None if nothing is known of it.
    - `point`: pixels of the image that was undistorted by the given lens.

    **Returns:** pixels of the image undistorted by the right one; finite and without meaning for a
    point that the rows' motion takes behind the camera.
    """
    to_pixels = lambda camera, n: (camera.K @ jnp.append(n, 1.0))[:2]
    to_normal = lambda camera, x: (jnp.linalg.inv(camera.K) @ jnp.append(x, 1.0))[:2]
    n = to_normal(given.camera, point)
    raw = to_pixels(given.camera, given.lens.distort(n))
    n = rig.lens.undistort(to_normal(rig.camera, raw), near=n)
    x = to_pixels(rig.camera, n)
    if around is None:
        return x
    late = rig.time_offset - given.time_offset
    seen = exposure(around, late + raw[1] * (rig.line_delay - given.line_delay))
    T_seen_stamp = seen.inverse() @ exposure(around, late)
    u, v, ratio = two_view_homography(rig.camera, rig.mount, T_seen_stamp) @ jnp.append(x, 1.0)
    return jnp.stack([u, v]) / jnp.where(ratio > 0.1, ratio, 1.0)  # of the depths, near 1


def corrected(given: Rig, rig: Rig, log: Observation) -> Observation:
    """A log [T] as the right rig would have made it."""

    def of_image(segments: Segments, around: Float[Array, "L 3"] | None) -> Segments:
        of_point = lambda x: retaken(given, rig, around, x)
        return Segments(jax.vmap(jax.vmap(of_point))(segments.endpoints), segments.valid)

    log = dataclasses.replace(
        log, segments_image=jax.vmap(of_image)(log.segments_image, log.around)
    )
    if log.around is None:
        return log
    before = jnp.concatenate([log.around[:1], log.around[:-1]])
    motion = jax.vmap(motion_between, in_axes=(None, None, 0, 0, 0))(
        given, rig, log.motion, before, log.around
    )
    first = jnp.arange(len(before)) == 0
    keep = lambda a, b: jnp.where(first.reshape(-1, *[1] * (a.ndim - 1)), a, b)
    return dataclasses.replace(log, motion=jax.tree.map(keep, log.motion, motion))
