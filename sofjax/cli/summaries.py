"""What was found, in a few lines for a person."""

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sofjax.evaluation import MapErrors, TrajectoryErrors
    from sofjax.io.drive import Drive
    from sofjax.pipeline import Calibration, DriveResult
    from sofjax.pipeline.stages import Closed

FULL = 0.99  # share of the true path, below which it is said
FEW = 3  # files that are named
CAMERA = "camera.yaml"

ROWS = (
    ("ate_m", "position, root mean square", "{:.3f} m"),
    ("ate_percent", "    of the path", "{:.2f} %"),
    ("max_m", "position, largest", "{:.3f} m"),
    ("yaw_deg", "heading, root mean square", "{:.2f}°"),
    ("drift_percent", "drift over a quarter of the path", "{:.2f} %"),
    ("end_gap_m", "end, from the first metre on", "{:.3f} m"),
)


def of_run(folder: Path | None, result: "DriveResult") -> str:
    """A run; `folder` is where it was written."""
    run_log, step, errors = result.log, result.log.step, result.errors
    n = len(run_log.stamps)
    path = run_log.trajectory.travelled[-1] if n else 0.0
    fps = run_log.frames_per_second
    stages = ", ".join(f"{stage} {ms:.1f}" for stage, ms in run_log.milliseconds().items())
    left = len(result.drive.image_files) - n
    lines = [
        f"{result.drive.name}: {n} images, {path:.1f} m"
        + f"; interrupted before {left} more" * result.interrupted,
        f"  segments  {run_log.detected} found, {step['below_horizon']} of them on the floor's "
        f"side of the horizon, {step['associated']} of those",
        f"            associated by eq. (9), {step['reobserved']} of those matched to the map",
        f"  map       {len(result.segments)} segments on the floor; {result.map.left_out} lines "
        "left out, above it or seen too little",
        *_closing(result.closed),
        f"  time      {sum(result.seconds.values()):.1f} s"
        + (f"; {fps:.0f} frames a second ({stages} ms)" if fps else ""),
    ]
    if errors.trajectory:
        lines += errors_table(errors.trajectory, errors.smoothed, errors.odometry, errors.map)
    lines += [f"  warning   {warning}" for warning in result.warnings]
    if run_log.unreadable:
        few = ", ".join(run_log.unreadable[:FEW])
        lines.append(f"            not read: {few}{' ...' * (len(run_log.unreadable) > FEW)}")
    return "\n".join([*lines, f"written to {folder}/"])


def _closing(closed: "Closed | None") -> list[str]:
    """What the closing did, in a line."""
    if closed is None:
        return []
    r = closed.report
    loops = f"{r['accepted']} loops closed, {r['refused']} refused"
    if "keyframes" not in r:
        return [f"  closed    {loops}"]
    return [
        f"  smoothed  {r['keyframes']} keyframes and {r['lines']} lines in {r['seconds']:.1f} s, "
        f"{r['merged']} described twice; {loops}" + "; it did not settle" * (not r["converged"])
    ]


def of_calibration(found: "Calibration") -> str:
    """A fitted rig."""
    from sofjax.calibration.assessment import SCALE

    drive, fit = found.drive, found.fit
    path = drive.odometry_at_images.travelled[-1]
    lines = [
        f"{drive.name}: {len(drive.image_files)} images, {path:.1f} m, {found.evidence}",
        *(f"  {line}" for line in found.estimates),
        *_held(found),
        f"  residual  {found.residual_px:.2f} px, root mean square",
        f"  starts    {fit.agreeing} of {len(fit.ends)} end in the same place",
        f"  scale     {SCALE}",
        f"  verdict   {found.verdict}: {found.sentence}",
    ]
    return "\n".join(lines)


def _held(found: "Calibration") -> list[str]:
    """What was held as it was given, and why, in a line each."""
    fit, lines = found.fit, []
    if fit.as_given:
        lines.append(f"  as given  {', '.join(fit.as_given)} (nothing contradicts them)")
    if fit.not_told:
        lines.append(f"  not told  {', '.join(fit.not_told)} (by this drive; they stay as given)")
    return lines


def next_command(command: str, drive: Path | None = None, put: Path | None = None) -> str:
    """What to type next, in a line.

    **Arguments:**
    - `drive`: the folder to type it for; DRIVE if none is known.
    - `put`: a camera file that must lie in that folder before.
    """
    folder = "DRIVE" if drive is None else shlex.quote(str(drive))
    then = f"sofjax {command} {folder}"
    if put is None or (drive is not None and put.resolve() == (drive / CAMERA).resolve()):
        return f"next: {then}"
    return f"next: cp {shlex.quote(str(put))} {folder}/{CAMERA}, then {then}"


def after_run(folder: Path, drive: "Drive") -> str:
    """What to type after a run; without the truth there is nothing to compare it with."""
    then = f"next: sofjax evaluate {shlex.quote(str(folder))}"
    return then if drive.groundtruth else f"{then}, once its drive has a groundtruth.txt"


def errors_table(
    trajectory: "TrajectoryErrors",
    smoothed: "TrajectoryErrors | None",
    odometry: "TrajectoryErrors | None",
    of_map: "MapErrors | None",
) -> list[str]:
    """Lines that set the estimates beside the odometry, and the map below."""
    columns = [("sofjax", trajectory), ("smoothed", smoothed), ("odometry", odometry)]
    columns = [(name, errors) for name, errors in columns if errors]
    table = [("against the truth, aligned without scale", [name for name, _ in columns])]
    for name, label, form in ROWS:
        values = [_number(form, getattr(errors, name)) for _, errors in columns]
        table.append((f"  {label}", values))
    if trajectory.coverage < FULL:
        table.append(("  share of the true path", [f"{trajectory.coverage:.2f}"]))
    if of_map:
        table += [
            ("  map, precision", [f"{of_map.precision:.2f}"]),
            ("  map, recall", [f"{of_map.recall:.2f}"]),
            ("  map, error", [_number("{:.1f} mm", 1e3 * of_map.error_m)]),
        ]
    width = max(10, 2 + max(len(value) for _, values in table for value in values))
    return [f"  {label:40}" + "".join(f"{v:>{width}}" for v in values) for label, values in table]


def _number(form: str, value: float) -> str:
    """With its unit; a dash for what cannot be said."""
    return form.format(value) if math.isfinite(value) else "-"
