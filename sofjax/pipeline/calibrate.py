"""`calibrate_drive`: what camera, mount, clock and odometer are, from what is seen on a drive."""

import dataclasses
import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import SupportsFloat

import jax
import jax.numpy as jnp
import numpy as np

from sofjax._pytree import in_double
from sofjax.calibration import (
    MOUNT,
    TURNS,
    UNKNOWNS,
    DriveFit,
    DriveFitConfig,
    FitConfig,
    fit_drive,
)
from sofjax.calibration.assessment import accuracy, doubts, estimates, grade, too_wide
from sofjax.calibration.joint import fit_jointly
from sofjax.extraction.observation import Observation
from sofjax.geometry import Camera
from sofjax.io.camera_file import MOUNT_FIELDS, CameraFile, RigFields, write_intrinsics
from sofjax.io.drive import Drive
from sofjax.io.errors import InputError
from sofjax.motion import BIAS
from sofjax.pipeline.outcomes import FitVerdict
from sofjax.pipeline.progress import Progress, watched
from sofjax.pipeline.setup_checks import fitted_height
from sofjax.rig import INTRINSICS, RIG, Rig, corrected
from sofjax.slam.presets import PRESETS
from sofjax.vision import Frontend, FrontendSettings, observe_drive

BY_DEFAULT = MOUNT[:3]
# what a drive may tell beside them. Not the line delay: at a constant speed it is like a bent lens
IF_TOLD = tuple(name for name in RIG if name not in (*BY_DEFAULT, "line_delay"))
STANDS_STILL = 0.05  # metres and radians, below which a drive tells nothing of a rig
FRONTEND = FrontendSettings(capacity=256)  # a fit is sure by many lines, of which a run needs few
STEP = 32  # capacities are multiples of it
COMPARED = 4e6  # pairs of segments of successive images, of a whole drive: what a fit has time for


@dataclass(frozen=True)
class Calibration:
    """A drive's rig, judged."""

    drive: Drive  # with the rig as it was
    camera_file: CameraFile  # with the new one, whether it is usable or not
    verdict: FitVerdict
    sentence: str  # how well the mount is known, or why it is not
    evidence: str  # what it is from, in words
    estimates: list[str]  # each number that was fitted, in words
    residual_px: float  # root mean square
    odometer: np.ndarray  # [4] systematic errors of the odometer
    covariance: np.ndarray  # [17, 17] of `UNKNOWNS`, in the units of `rig.RIG`
    fit: DriveFit

    @property
    def usable(self) -> bool:
        return self.verdict != FitVerdict.NOT_USABLE

    @property
    def calibrated_drive(self) -> Drive:
        """The drive with the new rig."""
        return dataclasses.replace(self.drive, camera_file=self.camera_file)

    @property
    def numbers(self) -> dict[str, object]:
        """All of it by name, for `report.json`."""
        sigma = np.sqrt(np.diag(self.covariance))
        observable = np.asarray(self.fit.fit.observable)
        unit = {"height": float(self.camera_file.mount.height)}  # metres, as `before` and `after`
        by = np.asarray(self.fit.estimate.by)
        return {
            "usable": self.usable,
            "verdict": self.sentence,
            "grade": str(self.verdict),
            "pairs": int(self.fit.pairs.valid.sum()),
            "related": self.fit.related,
            "residual_px": self.residual_px,
            "surprise": float(self.fit.fit.birge_ratio),
            "starts_agreeing": self.fit.agreeing,
            "before": {k: float(getattr(self.drive.camera_file.mount, k)) for k in MOUNT},
            "after": {k: float(getattr(self.camera_file.mount, k)) for k in MOUNT},
            "fitted": list(self.fit.free),
            "as_given": list(self.fit.as_given),
            "not_told": list(self.fit.not_told),
            "changed_by": {k: float(by[UNKNOWNS.index(k)]) for k in self.fit.free},
            "sigma": {k: float(s) * unit.get(k, 1.0) for k, s in zip(UNKNOWNS, sigma, strict=True)},
            "odometer": dict(zip(BIAS, self.odometer.tolist(), strict=True)),
            "observable": dict(zip(UNKNOWNS, observable.tolist(), strict=True)),
        }

    def write(self, path: Path) -> None:
        """The camera file with what was fitted; all else as it was."""
        file = self.camera_file
        notes = [f"calibrated on {self.drive.name}, {self.evidence}", *self.estimates]
        write_intrinsics(
            path, file.camera, file.distortion_model, file.distortion, file.name,
            {key: getattr(file.mount, key) for key in MOUNT_FIELDS}, notes, file.rig_fields,
        )  # fmt: skip


def calibrate_drive(
    drive: Drive,
    frontend: FrontendSettings = FRONTEND,
    free: tuple[str, ...] = BY_DEFAULT,
    joint: bool = False,
    progress: Progress | None = None,
    more: tuple[str, ...] = (),
    robot: bool = False,
) -> Calibration:
    """The rig fitted to a drive, and what it is worth.

    **Arguments:**
    - `drive`: of some metres; its mount is where the fit begins, 30 % and 8 degrees off will do.
    - `free`: what to fit, of `calibration.UNKNOWNS`; the odometer's errors in turning always are.
    - `joint`: then solve all poses, lines, their heights and the mount together.
    - `progress`: called after each image that is searched.
    - `more`: what else to fit where the drive contradicts it as it was given, such as `IF_TOLD`.
    - `robot`: whether the new camera file has the odometer's errors too, and how well each number
      is known.

    **Raises:** `InputError` if the robot never moves; `ValueError` for what cannot be fitted.
    """
    _check_free((*free, *more), joint)
    _check_moves(drive)
    images = functools.partial(watched, progress=progress)
    log = _narrowed(observe_drive(drive, Frontend.of(drive, frontend), images))
    config = _config(drive.camera_file, free, more)
    with jax.enable_x64(True):
        given, log = in_double((drive.camera_file.rig, log))
        found = fit_drive(given, log, config)
        assessment = found.verdict(config)
        usable = assessment.usable
        found, covariance = jax.device_get(found), found.covariance
        rig = jax.device_get(found.estimate.rig)
        if usable and joint:
            rig, covariance = _jointly(found, log, free)
        residuals = np.asarray(found.fit.residuals)[np.asarray(found.pairs.valid)]
    file = _fitted_file(drive.camera_file, found, rig, covariance, robot)
    doubt = "; ".join([
        *filter(None, [doubts(found.fit, config.fit)]),
        *fitted_height(float(rig.mount.height), float(drive.camera_file.mount.height)),
    ])  # fmt: skip
    evidence = f"{len(residuals)} of {found.related} pairs of segments taken for floor"
    evidence += ", then jointly with poses and lines" * (usable and joint)
    known = accuracy(covariance) + f"; {doubt}" * bool(doubt)
    verdict = FitVerdict(grade(covariance))
    if usable and verdict == FitVerdict.NOT_USABLE:
        assessment, usable = too_wide(covariance, doubt), False
    verdict = FitVerdict.DOUBTFUL if doubt else verdict
    odometer = np.asarray(found.fit.odometer)
    return Calibration(
        drive=drive,
        camera_file=file,
        verdict=verdict if usable else FitVerdict.NOT_USABLE,
        sentence=known if usable else assessment.sentence,
        evidence=evidence,
        estimates=estimates(rig, odometer, covariance, found.free),
        residual_px=float(np.sqrt(np.mean(residuals**2))) if len(residuals) else math.nan,
        odometer=odometer,
        covariance=covariance,
        fit=found,
    )


def _narrowed(log: Observation) -> Observation:
    """A log with no more room than its fullest image needs; the longer it is, the less."""
    images, most = len(log.overflow), int(np.asarray(log.segments_image.valid).sum(1).max())
    most = min(most, int((COMPARED / images) ** 0.5))
    room = max(STEP, -(-most // STEP) * STEP)
    segments = jax.tree.map(lambda a: a[:, :room], log.segments_image)
    return dataclasses.replace(log, segments_image=segments)


def _config(file: CameraFile, free: tuple[str, ...], more: tuple[str, ...]) -> DriveFitConfig:
    """What is known beforehand is what the file says of it."""
    usual = FitConfig().prior_sigma
    known = [file.rig_fields.sigma.get(name, sigma) if name in INTRINSICS else sigma
             for name, sigma in zip(UNKNOWNS, usual, strict=True)]  # fmt: skip
    # the odometer's turning errs more than anything; its distance is the measure of the height
    fit = FitConfig(
        free=tuple(dict.fromkeys([*free, *TURNS])),
        prior_sigma=tuple(max(sigma, 1e-6) for sigma in known),
    )
    return DriveFitConfig(fit=fit, more=more)


def _fitted_file(
    file: CameraFile, found: DriveFit, rig: Rig, covariance: np.ndarray, robot: bool
) -> CameraFile:
    """The camera file with what was fitted, in its own precision; what was held is untouched."""
    given = file.rig
    moved = {UNKNOWNS[i] for i in np.flatnonzero(np.asarray(found.estimate.by))}
    number = lambda value: jnp.asarray(value, float)
    mount = jax.tree.map(number, rig.mount)
    camera, distortion, fields = file.camera, file.distortion, file.rig_fields
    if moved & {"focal", "cx", "cy"}:
        camera = Camera(number(rig.camera.K), camera.width, camera.height)
    if moved & {"k1", "k2"}:
        by = np.asarray(rig.lens.coefficients - np.asarray(given.lens.coefficients), float)
        distortion = np.pad(distortion, (0, max(0, 2 - len(distortion))))
        distortion = distortion + np.pad(by[:2], (0, len(distortion) - 2))
    for name in moved & {"time_offset", "line_delay"}:
        fields = dataclasses.replace(fields, **{name: _short(getattr(rig, name))})
    if robot:
        sigma = dict(zip(UNKNOWNS, map(_short, np.sqrt(np.diag(covariance))), strict=True))
        known = {name: value for name, value in sigma.items() if value}
        odometer = tuple(map(_short, found.fit.odometer))
        known = {**fields.sigma, **known}
        fields = RigFields(fields.time_offset, fields.line_delay, odometer, known)
    return dataclasses.replace(
        file, camera=camera, mount=mount, distortion=distortion, rig_fields=fields
    )


def _short(value: SupportsFloat) -> float:
    """A fitted number to the digits that it can have."""
    return float(f"{float(value):.6g}")


def _check_free(free: tuple[str, ...], joint: bool) -> None:
    for name in free:
        if name not in UNKNOWNS:
            raise ValueError(f"there is no {name!r} to fit; known are {', '.join(UNKNOWNS)}")
    some = MOUNT if joint else RIG
    if not set(free) & set(some):
        raise ValueError(f"one of {', '.join(some)} at least must be free")
    if joint and "distance" in free:
        raise ValueError("'joint' keeps the odometer's distances; 'distance' cannot be free")


def _check_moves(drive: Drive) -> None:
    at = drive.odometry_at_images
    turned = float(np.abs(np.diff(at.yaw)).sum())
    if at.travelled[-1] < STANDS_STILL and turned < STANDS_STILL:
        raise InputError(
            f"{drive.path}: the robot moves by {at.travelled[-1]:.3f} m and turns by "
            f"{math.degrees(turned):.1f}° in all; a mount can only be fitted to a drive of some "
            "metres"
        )


def _jointly(found: DriveFit, log: Observation, free: tuple[str, ...]) -> tuple[Rig, np.ndarray]:
    """The rig of the joint solve, and a covariance that covers its difference to the pairs'."""
    rig = found.estimate.rig
    pairs = jax.device_get(rig.mount)
    log = corrected(found.estimate.given, rig, log)
    solved = fit_jointly(PRESETS["default"], rig.camera, rig.mount, log, free)
    mount = jax.device_get(solved.mount)
    off = [float(getattr(mount, k) - getattr(pairs, k)) for k in MOUNT]
    off[0] /= float(mount.height)
    difference = np.pad(np.array(off), (0, len(UNKNOWNS) - len(off)))
    # residuals of one line, one image, one odometer are not independent: the joint solve's own
    # covariance is too narrow by far
    return (
        jax.device_get(dataclasses.replace(rig, mount=solved.mount)),
        found.covariance + np.outer(difference, difference),
    )
