"""What cannot be scored is refused by name; sizes and types always, values where they are known."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sofjax._checks import value_of
from sofjax.geometry.camera import Camera, Mount
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.likelihood.sensor_model import LineNoise

FAR = 200.0  # metres from the robot at which no segment of a floor is seen: these are pixels
NEAR = 4.0  # pixels within which no image lies: these are metres


def check_problem(
    particles: SE2,
    observed: Segments,
    segment_map: Segments,
    noise: LineNoise,
    used: Bool[Array, "N M"] | None = None,
    covariance: Float[Array, "M 2 2"] | None = None,
) -> LineNoise:
    """Refuse what `log_likelihood` cannot use.

    **Returns:** the noise as arrays of the particles' type, so that a new value is not a new
    program.
    """
    check_poses("particles", particles)
    check_segments("observed", observed)
    check_segments("segment_map", segment_map)
    check_type("noise", noise, LineNoise, "a LineNoise(rho_sigma, theta_sigma, e_max)")
    if particles.xy.ndim != 2 or particles.yaw.ndim != 1:
        raise ValueError(
            f"particles must be N poses, xy [N, 2] and yaw [N], not xy {particles.xy.shape}; "
            "for one pose use pose.xy[None] and pose.yaw[None], and for more axes jax.vmap"
        )
    ends = value_of(observed.endpoints)
    if ends is not None and np.abs(_valid(ends, observed)).max(initial=0) > FAR:
        raise ValueError(
            f"observed has a coordinate of {np.abs(_valid(ends, observed)).max():.6g}: it must be "
            "in metres of the robot frame; pixels go into image_log_likelihood"
        )
    N, M = len(particles.yaw), len(observed.valid)
    if used is not None and (used.dtype != bool or used.shape != (N, M)):
        raise ValueError(
            f"used must be a mask of bool [{N}, {M}], not {used.dtype} {list(used.shape)}"
        )
    if covariance is not None and covariance.shape != (M, 2, 2):
        raise ValueError(f"covariance must be [{M}, 2, 2], not {list(covariance.shape)}")
    return jax.tree.map(lambda value: jnp.asarray(value, particles.xy.dtype), noise)


def check_image(camera: Camera, mount: Mount, segments_image: Segments) -> None:
    """Refuse what `image_log_likelihood` cannot use."""
    check_type("camera", camera, Camera, "a Camera")
    check_type("mount", mount, Mount, "a Mount")
    check_segments("segments_image", segments_image)
    ends = value_of(segments_image.endpoints)
    if ends is not None:
        ends = np.abs(_valid(ends, segments_image))
        if ends.size and ends.max() < NEAR:
            raise ValueError(
                f"segments_image has no coordinate above {ends.max():.3g}: it must be in pixels; "
                "metres of the robot frame go into log_likelihood"
            )


def check_poses(name: str, given: Any) -> None:
    """Refuse what is no poses, or poses that are not finite floating point numbers."""
    check_type(name, given, SE2, "poses SE2(xy [N, 2], yaw [N])")
    _check_floats(name, (given.xy, given.yaw))
    _check_finite(name, np.asarray(True), given.xy.reshape(-1, 2), given.yaw.reshape(-1))


def check_type(name: str, given: Any, kind: type, right: str) -> None:
    """Refuse what is of another type."""
    if not isinstance(given, kind):
        raise ValueError(f"{name} must be {right}, not {type(given).__name__}")


def check_segments(name: str, given: Any) -> None:
    """Refuse what is no row of segments, or has ends that are not finite where it is valid."""
    right = "Segments(endpoints [K, 2, 2], valid [K])"
    if not isinstance(given, Segments):
        also = "; Segments.of(array) makes it of end points" if hasattr(given, "shape") else ""
        raise ValueError(f"{name} must be {right}, not {type(given).__name__}{also}")
    ends, valid = given.endpoints, given.valid
    if ends.ndim != 3 or ends.shape[1:] != (2, 2) or valid.shape != ends.shape[:1]:
        shapes = f"endpoints {list(ends.shape)} and valid {list(valid.shape)}"
        raise ValueError(f"{name} must be {right}, not {shapes}")
    if valid.dtype != bool:
        raise ValueError(f"{name}.valid must be a mask of bool, not {valid.dtype}")
    _check_floats(name, (ends,))
    _check_finite(name, value_of(valid), ends)


def _check_floats(name: str, arrays: tuple[Array, ...]) -> None:
    for array in arrays:
        if not jnp.issubdtype(array.dtype, jnp.floating):
            raise ValueError(f"{name} must be floating point numbers, not {array.dtype}")


def _check_finite(name: str, valid: np.ndarray | None, *arrays: Array) -> None:
    for array in arrays:
        value = value_of(array)
        if value is None or valid is None:
            continue
        finite = np.isfinite(value).reshape(len(value), -1).all(axis=1) if value.size else True
        wrong = np.flatnonzero(~(finite | ~valid))
        if len(wrong):
            raise ValueError(f"{name} must be finite where it is valid; row {wrong[0]} is not")


def _valid(ends: np.ndarray, segments: Segments) -> np.ndarray:
    valid = value_of(segments.valid)
    return ends if valid is None else ends[valid]
