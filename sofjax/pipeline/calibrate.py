"""`calibrate_drive`: where the camera sits on the robot, from what it sees on a drive."""

import dataclasses
import functools
import math
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from sofjax._pytree import in_double
from sofjax.calibration import TURNS, UNKNOWNS, DriveFit, DriveFitConfig, FitConfig, fit_drive
from sofjax.calibration.assessment import doubts, estimates
from sofjax.calibration.joint import fit_jointly
from sofjax.extraction.observation import Observation
from sofjax.geometry import Camera, Mount
from sofjax.io.camera_file import MOUNT_FIELDS, CameraFile, write_intrinsics
from sofjax.io.drive import Drive
from sofjax.io.errors import InputError
from sofjax.pipeline.outcomes import FitVerdict
from sofjax.pipeline.progress import Progress, watched
from sofjax.pipeline.setup_checks import fitted_height
from sofjax.slam.presets import PRESETS
from sofjax.vision import Frontend, FrontendSettings, observe_drive

MOUNT, ODOMETER = UNKNOWNS[:4], UNKNOWNS[4:]
BY_DEFAULT = ("height", "pitch", "roll")
STANDS_STILL = 0.05  # metres and radians, below which a drive tells nothing of a mount
FRONTEND = FrontendSettings()


@dataclass(frozen=True)
class Calibration:
    """A drive's mount, judged."""

    drive: Drive  # with the mount as it was
    camera_file: CameraFile  # with the new mount, whether it is usable or not
    verdict: FitVerdict
    sentence: str  # how well the mount is known, or why it is not
    evidence: str  # what it is from, in words
    estimates: list[str]  # each number that was fitted, in words
    residual_px: float  # root mean square
    odometer: np.ndarray  # [4] systematic errors of the odometer
    covariance: np.ndarray  # [8, 8] of `UNKNOWNS`
    fit: DriveFit

    @property
    def usable(self) -> bool:
        return self.verdict != FitVerdict.NOT_USABLE

    @property
    def calibrated_drive(self) -> Drive:
        """The drive with the new mount."""
        return dataclasses.replace(self.drive, camera_file=self.camera_file)

    @property
    def numbers(self) -> dict[str, object]:
        """All of it by name, for `report.json`."""
        sigma = np.sqrt(np.diag(self.covariance))
        observable = np.asarray(self.fit.fit.observable)
        return {
            "usable": self.usable,
            "verdict": self.sentence,
            "pairs": int(self.fit.pairs.valid.sum()),
            "related": self.fit.related,
            "residual_px": self.residual_px,
            "surprise": float(self.fit.fit.birge_ratio),
            "starts_agreeing": self.fit.agreeing,
            "before": {k: float(getattr(self.drive.camera_file.mount, k)) for k in MOUNT},
            "after": {k: float(getattr(self.camera_file.mount, k)) for k in MOUNT},
            "sigma": dict(zip(UNKNOWNS, sigma.tolist(), strict=True)),
            "odometer": dict(zip(ODOMETER, self.odometer.tolist(), strict=True)),
            "observable": dict(zip(UNKNOWNS, observable.tolist(), strict=True)),
        }

    def write(self, path: Path) -> None:
        """The camera file with the new mount; lens and all else as they were."""
        file = self.camera_file
        notes = [f"mount from {self.drive.name}, {self.evidence}", *self.estimates]
        write_intrinsics(
            path, file.camera, file.distortion_model, file.distortion, file.name,
            {key: getattr(file.mount, key) for key in MOUNT_FIELDS}, notes,
        )  # fmt: skip


def calibrate_drive(
    drive: Drive,
    frontend: FrontendSettings = FRONTEND,
    free: tuple[str, ...] = BY_DEFAULT,
    joint: bool = False,
    progress: Progress | None = None,
) -> Calibration:
    """The mount fitted to a drive, and what it is worth.

    **Arguments:**
    - `drive`: of some metres; its mount is where the fit begins, 30 % and 8 degrees off will do.
    - `free`: what to fit, of `calibration.UNKNOWNS`; the odometer's errors in turning always are.
    - `joint`: then solve all poses, lines, their heights and the mount together.
    - `progress`: called after each image that is searched.

    **Raises:** `InputError` if the robot never moves; `ValueError` for what cannot be fitted.
    """
    _check_free(free, joint)
    _check_moves(drive)
    images = functools.partial(watched, progress=progress)
    log = observe_drive(drive, Frontend.of(drive, frontend), images)
    # the odometer's turning errs more than anything; its distance is the measure of the height
    config = DriveFitConfig(fit=FitConfig(free=tuple(dict.fromkeys([*free, *TURNS]))))
    with jax.enable_x64(True):
        camera, mount, log = in_double((drive.camera_file.camera, drive.camera_file.mount, log))
        found = fit_drive(camera, mount, log, config)
        assessment = found.verdict(config)
        usable = assessment.usable
        fitted, covariance = jax.device_get(found.fit.mount), found.covariance
        odometer = np.asarray(found.fit.odometer)
        if usable and joint:
            fitted, covariance = _jointly(camera, found, log, free)
        residuals = np.asarray(found.fit.residuals)[np.asarray(found.pairs.valid)]
    doubt = "; ".join([
        *filter(None, [doubts(found.fit, config.fit)]),
        *fitted_height(float(fitted.height), float(mount.height)),
    ])  # fmt: skip
    evidence = f"{len(residuals)} of {found.related} pairs of segments taken for floor"
    evidence += ", then jointly with poses and lines" * (usable and joint)
    fields = (jnp.asarray(value, float) for value in dataclasses.astuple(fitted))
    known = _accuracy(fitted, covariance) + f"; {doubt}" * bool(doubt)
    verdict = FitVerdict.DOUBTFUL if doubt else FitVerdict.GOOD
    return Calibration(
        drive=drive,
        camera_file=dataclasses.replace(drive.camera_file, mount=type(fitted)(*fields)),
        verdict=verdict if usable else FitVerdict.NOT_USABLE,
        sentence=known if usable else assessment.sentence,
        evidence=evidence,
        estimates=estimates(fitted, odometer, covariance, config.fit.free),
        residual_px=float(np.sqrt(np.mean(residuals**2))) if len(residuals) else math.nan,
        odometer=odometer,
        covariance=covariance,
        fit=found,
    )


def _check_free(free: tuple[str, ...], joint: bool) -> None:
    for name in free:
        if name not in UNKNOWNS:
            raise ValueError(f"there is no {name!r} to fit; known are {', '.join(UNKNOWNS)}")
    if not set(free) & set(MOUNT):
        raise ValueError(f"one of {', '.join(MOUNT)} at least must be free")
    if joint and "distance" in free:
        raise ValueError("'joint' keeps the odometer's distances; 'distance' cannot be free")


def _check_moves(drive: Drive) -> None:
    at = drive.odometry.at(drive.image_stamps)
    turned = float(np.abs(np.diff(at.yaw)).sum())
    if at.travelled[-1] < STANDS_STILL and turned < STANDS_STILL:
        raise InputError(
            f"{drive.path}: the robot moves by {at.travelled[-1]:.3f} m and turns by "
            f"{math.degrees(turned):.1f}° in all; a mount can only be fitted to a drive of some "
            "metres"
        )


def _jointly(
    camera: Camera, found: DriveFit, log: Observation, free: tuple[str, ...]
) -> tuple[Mount, np.ndarray]:
    """The mount of the joint solve, and a covariance that covers its difference to the pairs'."""
    pairs = jax.device_get(found.fit.mount)
    solved = fit_jointly(PRESETS["default"], camera, found.fit.mount, log, free)
    mount = jax.device_get(solved.mount)
    difference = np.array([getattr(mount, k) - getattr(pairs, k) for k in MOUNT] + [0.0] * 4)
    # residuals of one line, one image, one odometer are not independent: the joint solve's own
    # covariance is too narrow by far
    return mount, found.covariance + np.outer(difference, difference)


def _accuracy(mount: Mount, covariance: np.ndarray) -> str:
    """How well each of height, pitch and roll is known, if it was free."""
    sigma = np.sqrt(np.diag(covariance))
    share = 100 * sigma[0] / float(mount.height)
    parts = [f"height to {share:.2g} %"] * bool(sigma[0])
    parts += [f"{k} to {np.degrees(sigma[i]):.2g}°" for i, k in ((1, "pitch"), (2, "roll"))
              if sigma[i]]  # fmt: skip
    return "known " + ", ".join(parts) + ", apart from the odometer's scale"
