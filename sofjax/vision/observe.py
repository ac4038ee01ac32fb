"""From images and odometry to what the filter takes."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

from sofjax.extraction.observation import LAGS, Observation
from sofjax.geometry import SE2, Segments
from sofjax.io.drive import Drive, motion_sigmas, motions, ways_around
from sofjax.rig import Rig, retaken
from sofjax.vision.frontend import REPEATED, Frontend, ImageSegments

MOVED_XY, MOVED_YAW = 0.01, 0.01  # metres and radians: after a larger motion the image must change


def observation(
    view: ImageSegments,
    motion: np.ndarray,
    sigma: np.ndarray | None = None,
    around: np.ndarray | None = None,
) -> Observation:
    """One image's observation.

    **Arguments:**
    - `view`: the image's segments.
    - `motion`: [3], T_previous_current of the odometer as (dx, dy, dyaw), metres and radians.
    - `sigma`: [3], what is not known of it beyond the odometer's noise.
    - `around`: [L, 3], of `Observation`.
    """
    return Observation(
        segments_image=view.segments_image,
        motion=SE2(jnp.asarray(motion[:2], float), jnp.asarray(motion[2], float)),
        overflow=jnp.asarray(view.overflow, int),
        motion_sigma=None if sigma is None else jnp.asarray(sigma, float),
        around=None if around is None else jnp.asarray(around, float),
    )


def observations(
    drive: Drive, views: Iterable[ImageSegments]
) -> Iterator[tuple[ImageSegments, Observation]]:
    """Each view of a drive with its observation; a view that repeats the last one is emptied."""
    steps, sigmas, around = motions(drive), motion_sigmas(drive), ways_around(drive, LAGS)
    rig = drive.camera_file.rig
    for i, view in enumerate(without_repeats(views, steps)):
        observed = observation(view, steps[i], None if sigmas is None else sigmas[i], around[i])
        if drive.camera_file.rig_fields.line_delay:
            observed = _all_rows_at_once(rig, observed)
        yield view, observed


@jax.jit
def _all_rows_at_once(rig: Rig, observed: Observation) -> Observation:
    """The observation as a camera whose rows are not read out one after the other would make it."""
    at_once = dataclasses.replace(rig, line_delay=jnp.zeros(()))
    point = lambda x: retaken(at_once, rig, observed.around, x)
    ends = jax.vmap(jax.vmap(point))(observed.segments_image.endpoints)
    return dataclasses.replace(
        observed, segments_image=Segments(ends, observed.segments_image.valid)
    )


def without_repeats(views: Iterable[ImageSegments], steps: np.ndarray) -> Iterator[ImageSegments]:
    """Views in order; one with exactly the last one's segments after a motion is emptied.

    Then the camera, or its driver, is stuck.

    **Arguments:**
    - `steps`: [T, 3], the odometer's motion up to each image.
    """
    last, xy, yaw = None, 0.0, 0.0
    for view, (dx, dy, turn) in zip(views, steps, strict=True):
        xy, yaw = xy + float(np.hypot(dx, dy)), yaw + abs(float(turn))
        if last is not None and _same(view, last):
            if xy > MOVED_XY or yaw > MOVED_YAW:
                view = _emptied(view)
        elif view.detected:
            last, xy, yaw = view, 0.0, 0.0
        yield view


def _same(a: ImageSegments, b: ImageSegments) -> bool:
    first, second = (np.asarray(view.segments_image.endpoints) for view in (a, b))
    return 0 < a.detected == b.detected and np.array_equal(first, second)


def _emptied(view: ImageSegments) -> ImageSegments:
    none = Segments(
        jnp.zeros_like(view.segments_image.endpoints), jnp.zeros_like(view.segments_image.valid)
    )
    return dataclasses.replace(view, segments_image=none, overflow=0, detected=0, fault=REPEATED)


def observe_drive(
    drive: Drive, frontend: Frontend, progress: Callable[[Iterable], Iterable] = iter
) -> Observation:
    """A whole drive with a leading axis T: detected once, replayed as often as one likes.

    An image that cannot be read is one without segments. `progress` wraps the loop over the images.
    """
    views = (frontend.view(file) for file in progress(drive.image_files))
    each = [observed for _, observed in observations(drive, views)]
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *each)
