"""`sofjax inspect`: what is in a drive."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sofjax.io.drive import Drive
    from sofjax.vision import Frontend

SHOWN = 6  # images in the figure


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "inspect",
        help="say what is in a drive, and draw its segments",
        description="Say what is in a drive, and draw the segments of a few of its images.",
    )
    parser.add_argument("drive", metavar="DRIVE", type=Path, help="folder of the drive")
    parser.add_argument(
        "--out", metavar="FILE", type=Path, help="the figure; default: runs/<drive>-inspect.png"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    import sys

    from sofjax import viewer
    from sofjax.cli import outputs
    from sofjax.io.drive import read_drive
    from sofjax.vision import Frontend, check_images, read_image

    drive = read_drive(args.drive)
    out = args.out or Path("runs") / f"{drive.name}-inspect.png"
    outputs.check_figure(out)
    check_images(drive)
    unreadable = [file for file in drive.image_files if read_image(file) is None]
    print(describe(drive, unreadable))
    outputs.check_writable(out.parent)
    if not viewer.available():
        print(f"sofjax: {viewer.MISSING}", file=sys.stderr)
        return 0
    draw(out, drive, Frontend(drive.camera_file))
    print(f"drawn to {out}")
    return 0


def describe(drive: "Drive", unreadable: list[Path]) -> str:
    """The drive in a few lines for a person."""
    import numpy as np

    from sofjax.io.camera_file import doubts
    from sofjax.io.drive import outside

    stamps, odometry, camera_file = drive.image_stamps, drive.odometry, drive.camera_file
    camera, mount = camera_file.camera, camera_file.mount
    K = np.asarray(camera.K, float)
    across, down = (
        2 * np.degrees(np.arctan2(size / 2, f))
        for size, f in ((camera.width, K[0, 0]), (camera.height, K[1, 1]))
    )
    turned = np.diff(odometry.yaw)
    beyond = int(outside(odometry, stamps).sum())
    names = {"true path (groundtruth.txt)": drive.groundtruth,
             "true segments (floor_segments.csv)": drive.floor_segments}  # fmt: skip
    missing = [name for name, value in names.items() if value is None]
    lines = [
        f"{drive.name}",
        f"  images    {len(stamps)} of {camera.width}x{camera.height}, {_rate(stamps)}",
        f"            {len(unreadable)} cannot be read"
        + (f", {unreadable[0].name} first" if unreadable else ""),
        f"  camera    {camera_file.name}, {camera_file.distortion_model}: f {K[0, 0]:.1f} and "
        f"{K[1, 1]:.1f} px, {across:.0f}° by {down:.0f}°",
        f"  mount     {float(mount.height):.3f} m above the floor, pitch "
        f"{np.degrees(float(mount.pitch)):.1f}° down, {float(mount.x):.3f} m ahead of the axle",
        f"  odometry  {odometry.travelled[-1]:.1f} m, {_rate(odometry.stamps)}",
        f"            turns {np.degrees(turned[turned > 0].sum()):.0f}° left and "
        f"{-np.degrees(turned[turned < 0].sum()):.0f}° right; {beyond} images outside its time",
    ]
    if drive.groundtruth is not None:
        lines.append(f"  truth     {drive.groundtruth.travelled[-1]:.1f} m of path")
    if drive.floor_segments is not None:
        lines.append(f"            {len(drive.floor_segments)} segments on the floor")
    lines.append(f"  missing   {', '.join(missing) or 'nothing'}")
    return "\n".join(lines + [f"  warning   {doubt}" for doubt in doubts(camera_file)])


def _rate(stamps) -> str:
    """How many, how often, and the longest gap."""
    import numpy as np

    if len(stamps) < 2:
        return "one alone"
    steps = np.diff(stamps)
    usual, longest = np.median(steps), steps.argmax()
    gaps = int((steps > 2.5 * usual).sum())
    begin = f"{steps[longest]:.2f} s from {stamps[longest]:.2f} s on"
    span = f"{stamps[-1] - stamps[0]:.1f} s at {1 / usual:.1f} Hz"
    if not gaps:
        return f"{span} without a gap"
    return f"{span} with {gaps} gaps, the longest {begin}"


def draw(out: Path, drive: "Drive", frontend: "Frontend") -> None:
    """Draw a few images with their segments, told apart by eq. (9) and the odometer's motion."""
    import equinox as eqx
    import jax.numpy as jnp
    import numpy as np

    from sofjax import viewer
    from sofjax.geometry import SE2
    from sofjax.presets import PRESETS
    from sofjax.sof import extract
    from sofjax.vision import read_image

    config = PRESETS["default"].association
    camera, mount = drive.camera_file.camera, drive.camera_file.mount
    at = drive.odometry.at(drive.image_stamps)
    poses = SE2(jnp.asarray(at.xy, float), jnp.asarray(at.yaw, float))
    extract = eqx.filter_jit(extract)
    names, images, floor, other = [], [], [], []
    spread = np.linspace(0, len(at.stamps) - 1, SHOWN + 2).round()[1:-1]
    for i in np.unique(spread.astype(int)).tolist():
        image = read_image(drive.image_files[i])
        partner = _partner(at, i, config.baseline_distance, config.baseline_angle)
        second, first = (frontend.view(drive.image_files[k]) for k in (i, partner))
        if not second.readable:
            continue
        T_first_second = SE2(poses.xy[partner], poses.yaw[partner]).between(
            SE2(poses.xy[i], poses.yaw[i])
        )
        found = extract(
            config, camera, mount, first.segments_image, second.segments_image, T_first_second
        )
        on, valid = np.asarray(found.is_floor), np.asarray(second.segments_image.valid)
        endpoints = np.asarray(second.segments_image.endpoints)
        names.append(drive.image_files[i].name)
        images.append(frontend.undistort(image))
        floor.append(endpoints[on & valid])
        other.append(endpoints[~on & valid])
    title = f"{drive.name}: which segments move as the floor does, by eq. (9)"
    viewer.draw_images(out, title, names, images, floor, other)


def _partner(at, i: int, distance: float, angle: float) -> int:
    """The nearest image in time from which the robot has moved far enough; the farthest if none."""
    import numpy as np

    away = np.hypot(*(at.xy - at.xy[i]).T)
    enough = np.flatnonzero((away >= distance) | (np.abs(at.yaw - at.yaw[i]) >= angle))
    return int(enough[np.abs(enough - i).argmin()]) if len(enough) else int(away.argmax())
