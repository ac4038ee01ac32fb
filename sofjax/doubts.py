"""Sentences on what a drive and its run betray: worth a look, no reason to refuse."""

from collections.abc import Mapping

import numpy as np

from sofjax.io.camera_file import doubts as camera_doubts
from sofjax.io.drive import Drive, odometry_warnings
from sofjax.io.trajectory import gaps
from sofjax.motion import BIAS, MotionModel, prior_bias

FEW = 1 / 3  # of the segments on the floor's side, below which something is wrong ...
ENOUGH = 100  # ... if there are so many
SIGMAS = 5.0  # of its prior, beyond which a learned error of the odometer is no error of one
HOLE = 1.0  # seconds without an image that are told one by one
MANY = 5  # holes that are told


def set_up(associated: int, on_floor_side: int) -> list[str]:
    """Whether far fewer segments move as the floor does than where all numbers are right.

    **Arguments:**
    - `associated`: segments that eq. (9) takes for floor.
    - `on_floor_side`: segments below the horizon and within range.
    """
    if on_floor_side < ENOUGH or associated >= FEW * on_floor_side:
        return []
    return [
        f"only {100 * associated / on_floor_side:.0f} % of the segments on the floor's side of the "
        "horizon move as the floor does; where the set-up is right it is half of them and more. "
        "Likely causes, the likeliest first: pitch, height or roll of the mount; units or axes of "
        "the odometry; clocks of images and odometry that differ; the camera's matrix or lens"
    ]


def of_drive(drive: Drive) -> list[str]:
    """What reading a drive's files showed."""
    found = camera_doubts(drive.camera_file) + drive.remarks + drive.contradictions
    return found + odometry_warnings(drive) + holes(drive.image_stamps)


def odometer(learned: Mapping[str, float], model: MotionModel) -> list[str]:
    """Whether errors of the odometer were learned that are beyond all that its prior allows.

    **Arguments:**
    - `learned`: the errors by their names in `motion.BIAS`.
    - `model`: with the prior; what has a standard deviation of zero there was not learned.
    """
    priors = np.sqrt(np.diag(prior_bias(model).covariance)).tolist()
    prior_sigma = dict(zip(BIAS, priors, strict=True))
    found = []
    for name, value in learned.items():
        sigma = prior_sigma[name]
        if not sigma or not np.isfinite(value) or abs(value) <= SIGMAS * sigma:
            continue
        form = "{:+.3f} rad/m".format if name == "curvature" else "{:+.1%}".format
        of = "distances" if name == "distance" else name
        of = f"turns to the {name}" if name in ("left", "right") else of
        found.append(
            f"the odometer's error in {of} was learned as {form(value)}, {abs(value) / sigma:.0f} "
            "standard deviations of what odometers err by: are its units, its axes and the mount "
            "what they are taken for?"
        )
    return found


def holes(stamps: np.ndarray) -> list[str]:
    """Times without images, where a second or more passes.

    **Arguments:**
    - `stamps`: [T], seconds.
    """
    found = []
    for begin, seconds in gaps(stamps):
        if seconds >= HOLE:
            found.append(f"no image for {seconds:.2f} s from {begin:.2f} s on")
    if len(found) > MANY:
        found[MANY:] = [f"{len(found) - MANY} more times without an image for {HOLE:g} s and more"]
    return found
