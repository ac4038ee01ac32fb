"""Sentences on what looks wrong in a drive or its run: worth a look, no reason to refuse."""

import dataclasses
from collections.abc import Iterator, Mapping

import jax.numpy as jnp
import numpy as np

from sofjax.extraction.observation import Observation
from sofjax.extraction.sof import extract_along
from sofjax.geometry import SE2, Camera, Mount
from sofjax.geometry.angles import wrap
from sofjax.io.camera_file import doubts as camera_doubts
from sofjax.io.drive import Drive, motions, odometry_warnings
from sofjax.io.trajectory import Trajectory, gaps
from sofjax.motion import BIAS, MotionModel, prior_bias
from sofjax.slam.config import SlamConfig

FEW = 1 / 3  # of the segments on the floor's side, below which something is wrong ...
ENOUGH = 100  # ... if there are so many
FAR_OFF = 1.4  # times the height that was given, either way
ALIKE = 0.9  # of the share of the best explanation: another that may be it
MORE = 1.3  # times as many, and as large a share, are explained by what is wrong
SIGMAS = 5.0  # of its prior, beyond which a learned error is larger than odometers have
HOLE = 1.0  # seconds without an image, from which on a gap is named
MANY = 5  # gaps that are named one by one
HALF, DOUBLE = (0.4, 0.6), (1.7, 2.5)  # ratios that are called so


def set_up(config: SlamConfig, drive: Drive, log: Observation) -> list[str]:
    """Sentences if far fewer segments move as the floor does than should.

    Each of the usual mistakes is undone in turn: one that makes many more segments move as the
    floor does is named as the likely cause.

    **Arguments:**
    - `log`: observations of the drive's first images, leading T, as `vision.observations` gives.
    """
    camera, mount = drive.camera_file.camera, drive.camera_file.mount
    on_floor, on_side = _moving_as_floor(config, camera, mount, log)
    if on_side < ENOUGH:
        return []
    share, better = on_floor / on_side, []
    for words, odometry, other in _usual_mistakes(drive.odometry, mount):
        steps = motions(dataclasses.replace(drive, odometry=odometry))[: len(log.overflow)]
        motion = SE2(jnp.asarray(steps[:, :2], float), jnp.asarray(steps[:, 2], float))
        other_log = dataclasses.replace(log, motion=motion)
        then, of = _moving_as_floor(config, camera, other, other_log)
        if then > MORE * on_floor and then / max(of, 1) > max(MORE * share, FEW):
            better.append((then / of, words))
    better = [(more, words) for more, words in better if more > ALIKE * max(better)[0]]
    if share >= FEW and not better:
        return []
    said = (
        f"only {100 * share:.0f} % of the segments on the floor's side of the horizon move as the "
        "floor does; where the set-up is right half of them and more do. "
    )
    if better:
        better = sorted(better, reverse=True)
        causes = ", or ".join(
            f"{words} ({100 * more:.0f} % with that mended)" for more, words in better
        )
        return [f"{said}Likely cause: {causes}"]
    return [
        f"{said}Likely causes, the likeliest first: pitch, height or roll of the mount; the clocks "
        "of images and odometry; the camera's matrix or lens; the odometry's units or axes"
    ]


def _moving_as_floor(
    config: SlamConfig, camera: Camera, mount: Mount, log: Observation
) -> tuple[int, int]:
    """Segments that eq. (9) takes for floor, and those on the floor's side of the horizon."""
    config = config.in_metres(camera, mount)
    max_depth = config.filter.max_depth
    found, compared = extract_along(config.association, camera, mount, log, max_depth)
    on_side = found.segments_robot.valid & compared[:, None]
    return int(found.is_floor.sum()), int(on_side.sum())


def _usual_mistakes(odometry: Trajectory, mount: Mount) -> Iterator[tuple[str, Trajectory, Mount]]:
    """Each in words, and the odometry and the mount with it taken back."""
    stamps, xy, yaw = odometry.stamps, odometry.xy, odometry.yaw
    for times, words in (
        (2.0, "the odometry reads half of the way, or the mount's height is twice the true one"),
        (0.5, "the odometry reads twice the way, or the mount's height is half the true one"),
        (0.01, "the odometry is in centimetres"),
        (0.001, "the odometry is in millimetres"),
    ):
        yield words, Trajectory(stamps, times * xy, yaw), mount
    yield "x and y of the odometry are swapped", Trajectory(stamps, xy[:, ::-1], yaw), mount
    yield "the odometry's x and y have the wrong sign", Trajectory(stamps, -xy, yaw), mount
    yield "the odometry's heading has the wrong sign", Trajectory(stamps, xy, -yaw), mount
    for seconds in (-0.2, -0.1, 0.1, 0.2):
        words = f"the images are stamped {abs(seconds):g} s {'late' if seconds > 0 else 'early'}"
        yield words, Trajectory(stamps + seconds, xy, yaw), mount
    for turn in (-np.pi / 2, np.pi / 2, np.pi):
        roll = float(wrap(mount.roll + turn))
        turned = dataclasses.replace(mount, roll=jnp.asarray(roll, float))
        words = f"the mount's roll, {round(roll, 2) + 0.0:.2f} rather than {float(mount.roll):.2f}"
        yield words, odometry, turned


def fitted_height(fitted: float, start: float) -> list[str]:
    """A sentence if a fitted height, metres, differs from the first by more than measuring errs."""
    ratio = fitted / start
    if 1 / FAR_OFF < ratio < FAR_OFF:
        return []
    # the height is in the odometer's metres
    reads = f"{ratio:.2g} times"
    for word, (low, high) in (("half", HALF), ("double", DOUBLE)):
        reads = word if low < ratio < high else reads
    return [
        f"the height is {ratio:.2f} of the {start:g} m that the fit began at: does the odometer "
        f"read {reads} of the way, or was the height not measured?"
    ]


def of_drive(drive: Drive) -> list[str]:
    """Sentences on what reading a drive's files showed."""
    found = camera_doubts(drive.camera_file) + drive.remarks + drive.contradictions
    return found + odometry_warnings(drive) + holes(drive.image_stamps)


def odometer(learned: Mapping[str, float], model: MotionModel) -> list[str]:
    """Sentences on errors of the odometer that were learned and are far outside their prior.

    **Arguments:**
    - `learned`: the errors by their names in `motion.BIAS`.
    - `model`: with the prior; what has a standard deviation of zero there was not learned.
    """
    priors = np.sqrt(np.diag(prior_bias(model).covariance)).tolist()
    prior_sigma: dict[str, float] = dict(zip(BIAS, priors, strict=True))
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
