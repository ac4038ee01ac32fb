"""`sofjax calibrate mount`: the camera's height and tilt from a drive."""

import argparse
import dataclasses
import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sofjax.io.errors import InputError, nearest, quoted

if TYPE_CHECKING:
    from sofjax.calibration import DriveFit
    from sofjax.extraction.observation import Observation
    from sofjax.geometry import Mount
    from sofjax.io.camera_file import CameraFile
    from sofjax.io.drive import Drive
    from sofjax.vision import Frontend, FrontendSettings

REFUSED = 3  # exit code: all was read, and nothing can be known from it
# calibration.UNKNOWNS, which would take the parser a second to import
FREE = ("height", "pitch", "roll", "yaw", "distance", "left", "right", "curvature")
BY_DEFAULT = "height,pitch,roll"


def add_parser(parts: argparse._SubParsersAction) -> None:
    parser = parts.add_parser(
        "mount",
        help="the camera's height and tilt from a drive",
        description="Fit where the camera sits on the robot to what it sees on a drive: some "
        "metres over a floor with lines across the way, with straight parts.",
    )
    parser.add_argument("drive", metavar="DRIVE", type=Path, help="folder of the drive")
    parser.add_argument(
        "--initial",
        metavar="height=1.0,pitch=0.2,...",
        help="where to begin, metres and radians, in the place of what the camera file says; "
        "30 %% and 8 degrees off will do",
    )
    parser.add_argument(
        "--free",
        metavar="height,pitch,...",
        default=BY_DEFAULT,
        help=f"what to fit, of {', '.join(FREE)} (the last four are "
        f"the odometer's errors, and those in turning are always free); default {BY_DEFAULT}",
    )
    parser.add_argument(
        "--joint",
        action="store_true",
        help="then solve all poses, lines, their heights and the mount together",
    )
    parser.add_argument(
        "-o",
        "--out",
        metavar="FILE",
        type=Path,
        default=Path("camera.yaml"),
        help="the camera file to write; default camera.yaml. A figure is drawn beside it. "
        "Files that sofjax has not written are not replaced",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Read, detect, fit, judge, draw, write."""
    from sofjax.cli import mount_figure
    from sofjax.io.drive import read_drive
    from sofjax.pipeline import run_folder
    from sofjax.vision import FrontendSettings

    free = free_names(args.free)
    if args.joint and "distance" in free:
        raise InputError("--joint keeps the odometer's distances; leave 'distance' out of --free")
    if args.out.is_dir():
        raise InputError(f"{args.out}: is a folder; -o must name a file, such as camera.yaml")
    figure = args.out.with_suffix(".png")
    run_folder.check_camera(args.out)
    run_folder.check_figure(figure)
    drive = begin_at(read_drive(args.drive), args.initial)
    run_folder.check_writable(args.out.parent)
    found = calibrate(drive, FrontendSettings(), free, args.joint)
    print(found.summary)
    if found.usable:
        write(args.out, found)
        print(f"written to {args.out}")
    else:
        print(f"{args.out} is not written")
    mount_figure.draw(figure, drive, found)
    return 0 if found.usable else REFUSED


def fit_before_run(drive: "Drive", settings: "FrontendSettings", folder: Path) -> "Calibration":
    """What `sofjax run --calibrate` does first; camera file and figure go into its folder."""
    from sofjax.cli import mount_figure
    from sofjax.pipeline import run_folder

    found = calibrate(drive, settings, free_names(BY_DEFAULT))
    print(found.summary)
    if found.usable:
        write(folder / run_folder.CAMERA, found)
    else:
        print("the drive is not run: measure the mount, or leave --calibrate out")
    mount_figure.draw(folder / run_folder.MOUNT, drive, found)
    return found


@dataclass(frozen=True)
class Calibration:
    """A drive's mount, judged."""

    camera_file: "CameraFile"  # with the new mount, whether it is usable or not
    usable: bool
    verdict: str
    notes: list[str]  # the numbers, for the file
    summary: str  # all of it, for a person
    numbers: dict[str, object]  # for the report
    fit: "DriveFit"


def free_names(text: str) -> tuple[str, ...]:
    """The names of --free, checked."""
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",")))
    for name in names:
        if name not in FREE:
            raise InputError(f"--free: there is no {quoted(name)}; {nearest(name, FREE)}")
    if not set(names) & set(FREE[:4]):
        raise InputError("--free: one of height, pitch, roll and yaw at least must be free")
    return names


def begin_at(drive: "Drive", initial: str | None) -> "Drive":
    """The drive with some of its mount's fields as the user gives them."""
    import jax.numpy as jnp
    import numpy as np

    from sofjax.io.camera_file import check_floor_in_view, mount_fields

    if initial is None:
        return drive
    given = mount_fields("--initial", initial)
    camera, mount = drive.camera_file.camera, drive.camera_file.mount
    values = {f.name: getattr(mount, f.name) for f in dataclasses.fields(mount)}
    values |= {key: jnp.asarray(value, float) for key, value in given.items()}
    K = np.asarray(camera.K, float)
    plain = {key: float(value) for key, value in values.items()}
    check_floor_in_view("--initial", K, camera.width, camera.height, plain)
    return with_mount(drive, type(mount)(**values))


def with_mount(drive: "Drive", mount: "Mount") -> "Drive":
    file = dataclasses.replace(drive.camera_file, mount=mount)
    return dataclasses.replace(drive, camera_file=file)


def calibrate(
    drive: "Drive", settings: "FrontendSettings", free: tuple[str, ...], joint: bool = False
) -> Calibration:
    """Fit the mount to a drive.

    **Raises:** `InputError` if the robot never moves.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from sofjax.calibration import TURNS, DriveFitConfig, FitConfig, fit_drive
    from sofjax.calibration.assessment import SCALE, estimates
    from sofjax.calibration.fit import doubts
    from sofjax.pipeline.setup_checks import fitted_height
    from sofjax.vision import Frontend

    at = drive.odometry.at(drive.image_stamps)
    turned = float(np.abs(np.diff(at.yaw)).sum())
    if at.travelled[-1] < 0.05 and turned < 0.05:
        raise InputError(
            f"{drive.path}: the robot moves by {at.travelled[-1]:.3f} m and turns by "
            f"{math.degrees(turned):.1f}° in all; a mount can only be fitted to a drive of some "
            "metres"
        )
    log = observed(drive, Frontend.of(drive, settings))
    # the odometer's turning errs more than anything; its distance is the measure of the height
    rules = DriveFitConfig(fit=FitConfig(free=tuple(dict.fromkeys([*free, *TURNS]))))
    with jax.enable_x64(True):
        double = lambda leaf: jnp.asarray(leaf, float if leaf.dtype.kind == "f" else leaf.dtype)
        camera, mount, log = jax.tree.map(
            lambda a: double(np.asarray(a)),
            (drive.camera_file.camera, drive.camera_file.mount, log),
        )
        found = fit_drive(camera, mount, log, rules)
        usable, why = found.verdict(rules)
        fitted, covariance = jax.device_get(found.fit.mount), found.covariance
        odometer = np.asarray(found.fit.odometer)
        if usable and joint:
            fitted, covariance = _jointly(camera, found, log, free)
        residuals = np.asarray(found.fit.residuals)[np.asarray(found.pairs.valid)]
    rms = float(np.sqrt(np.mean(residuals**2))) if len(residuals) else math.nan
    lines = estimates(fitted, odometer, covariance, rules.fit.free)
    pairs = len(residuals)
    doubt = "; ".join([
        *filter(None, [doubts(found.fit)]),
        *fitted_height(float(fitted.height), float(mount.height)),
    ])  # fmt: skip
    verdict = _words(fitted, covariance) + f"; {doubt}" * bool(doubt) if usable else why
    word = ("doubtful" if doubt else "good") if usable else "not usable"
    count = f"{pairs} of {found.related} pairs of segments taken for floor"
    count += ", then jointly with poses and lines" * (usable and joint)
    print_lines = [
        f"{drive.name}: {len(drive.image_files)} images, {at.travelled[-1]:.1f} m, {count}",
        *(f"  {line}" for line in lines),
        f"  residual  {rms:.2f} px, root mean square",
        f"  starts    {found.agreeing} of {len(found.ends)} end in the same place",
        f"  scale     {SCALE}",
        f"  verdict   {word}: {verdict}",
    ]
    values = np.array([fitted.height, fitted.pitch, fitted.roll, fitted.yaw], float)
    numbers = {
        "usable": usable,
        "verdict": verdict,
        "pairs": pairs,
        "related": found.related,
        "residual_px": rms,
        "surprise": float(found.fit.birge_ratio),
        "starts_agreeing": found.agreeing,
        "before": {k: float(getattr(mount, k)) for k in FREE[:4]},
        "after": dict(zip(FREE[:4], values.tolist(), strict=True)),
        "sigma": dict(zip(FREE, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
        "odometer": dict(zip(FREE[4:], odometer.tolist(), strict=True)),
        "observable": dict(zip(FREE, np.asarray(found.fit.observable).tolist(), strict=True)),
    }
    fields = (jnp.asarray(value, float) for value in dataclasses.astuple(fitted))
    file = dataclasses.replace(drive.camera_file, mount=type(fitted)(*fields))
    notes = [f"mount from {drive.name}, {count}", *lines]
    return Calibration(file, usable, verdict, notes, "\n".join(print_lines), numbers, found)


def observed(drive: "Drive", frontend: "Frontend") -> "Observation":
    """All images searched for segments, with a bar."""
    from tqdm import tqdm

    from sofjax.vision import observe_drive

    bar = functools.partial(tqdm, desc="segments", unit=" images", disable=None)
    return observe_drive(drive, frontend, bar)


def _jointly(camera, found: "DriveFit", log: "Observation", free: tuple[str, ...]):
    """The mount of the joint solve, and a covariance that its difference to the pairs' is in."""
    import jax
    import numpy as np

    from sofjax.calibration.joint import fit_jointly
    from sofjax.slam.presets import PRESETS

    pairs = jax.device_get(found.fit.mount)
    mount = fit_jointly(PRESETS["default"], camera, found.fit.mount, log, free)
    mount = jax.device_get(mount.mount)
    apart = np.array([getattr(mount, k) - getattr(pairs, k) for k in FREE[:4]] + [0.0] * 4)
    # residuals of one line, one image, one odometer are not independent: the joint solve's own
    # covariance is too narrow by far
    return mount, found.covariance + np.outer(apart, apart)


def _words(mount: "Mount", covariance) -> str:
    import numpy as np

    sigma = np.sqrt(np.diag(covariance))
    share = 100 * sigma[0] / float(mount.height)
    parts = [f"height to {share:.2g} %"] * bool(sigma[0])
    parts += [f"{k} to {np.degrees(sigma[i]):.2g}°" for i, k in ((1, "pitch"), (2, "roll"))
              if sigma[i]]  # fmt: skip
    return "known " + ", ".join(parts) + ", apart from the odometer's scale"


def write(path: Path, found: Calibration) -> None:
    """The camera file with the new mount; lens and all else as they were."""
    from sofjax.io.camera_file import MOUNT_FIELDS, write_intrinsics

    file = found.camera_file
    write_intrinsics(
        path, file.camera, file.distortion_model, file.distortion, file.name,
        {key: getattr(file.mount, key) for key in MOUNT_FIELDS}, found.notes,
    )  # fmt: skip
