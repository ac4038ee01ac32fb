"""`sofjax inspect`: what is in a drive."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from sofjax.cli import summaries
from sofjax.cli.progress import bar

if TYPE_CHECKING:
    import numpy as np

    from sofjax.pipeline import Inspection

DOUBTFUL = 3  # exit code: all was read, and a run on it would mislead


def run(args: argparse.Namespace) -> int:
    """Read, search all images, print, draw."""
    from sofjax import viewer
    from sofjax.io.drive import read_drive
    from sofjax.pipeline import figures, inspect_drive, run_folder
    from sofjax.vision import Frontend

    drive = read_drive(args.drive)
    frontend = Frontend.of(drive)
    out = args.out or Path("runs") / f"{drive.name}-inspect.png"
    run_folder.check_figure(out)
    run_folder.check_writable(out.parent)
    with bar(len(drive.image_files), drive.name) as progress:
        found = inspect_drive(drive, frontend, progress)
    print(describe(found))
    for warning in found.warnings:
        print(f"  warning   {warning}")
    print(f"  verdict   {found.verdict}")
    if figures.draw_inspection(out, found):
        print(f"drawn to {out}")
    else:
        print(f"sofjax: {viewer.MISSING}", file=sys.stderr)
    print(summaries.next_command("calibrate robot" if found.contradictions else "run", args.drive))
    return DOUBTFUL if found.contradictions else 0


def describe(found: "Inspection") -> str:
    """The drive in a few lines for a person."""
    import numpy as np

    drive, seen = found.drive, found.seen
    stamps, odometry, camera_file = drive.image_stamps, drive.odometry, drive.camera_file
    camera, mount = camera_file.camera, camera_file.mount
    K = np.asarray(camera.K, float)
    across, down = (
        2 * np.degrees(np.arctan2(size / 2, f))
        for size, f in ((camera.width, K[0, 0]), (camera.height, K[1, 1]))
    )
    turned = np.diff(odometry.yaw)
    share = seen.associated / seen.below_horizon if seen.below_horizon else 0.0
    faults = seen.faults.items()
    names = {"true path (groundtruth.txt)": drive.groundtruth,
             "true segments (floor_segments.csv)": drive.floor_segments}  # fmt: skip
    missing = [name for name, value in names.items() if value is None]
    lines = [
        f"{drive.name}",
        f"  images    {len(stamps)} of {camera.width}x{camera.height}, {_rate(stamps)}",
        *(f"            {len(files)} {fault}, {files[0].name} first" for fault, files in faults),
        f"  segments  {seen.segments} found, {seen.below_horizon} of them on the floor's side of "
        f"the horizon, {seen.associated} of those",
        f"            associated by eq. (9), {100 * share:.0f} %",
        f"  camera    {camera_file.name}, {camera_file.distortion_model}: f {K[0, 0]:.1f} and "
        f"{K[1, 1]:.1f} px, {across:.0f}° by {down:.0f}°",
        f"  mount     {float(mount.height):.3f} m above the floor, pitch "
        f"{np.degrees(float(mount.pitch)):.1f}° down, {float(mount.x):.3f} m ahead of the axle",
        f"  odometry  {odometry.travelled[-1]:.1f} m, {_rate(odometry.stamps)}",
        f"            turns {np.degrees(turned[turned > 0].sum()):.0f}° left and "
        f"{-np.degrees(turned[turned < 0].sum()):.0f}° right",
    ]
    if drive.groundtruth is not None:
        lines.append(f"  truth     {drive.groundtruth.travelled[-1]:.1f} m of path")
    if drive.floor_segments is not None:
        lines.append(f"            {len(drive.floor_segments)} segments on the floor")
    lines.append(f"  missing   {', '.join(missing) or 'nothing'}")
    return "\n".join(lines)


def _rate(stamps: "np.ndarray") -> str:
    """How many, how often, and the longest gap."""
    import numpy as np

    from sofjax.io.trajectory import gaps

    if len(stamps) < 2:
        return "one alone"
    found = gaps(stamps)
    span = f"{stamps[-1] - stamps[0]:.1f} s at {1 / np.median(np.diff(stamps)):.1f} Hz"
    if not found:
        return f"{span} without a gap"
    begin, seconds = max(found, key=lambda gap: gap[1])
    return f"{span} with {len(found)} gaps, the longest {seconds:.2f} s from {begin:.2f} s on"
