"""`sofjax inspect`: what is in a drive."""

import argparse
import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from sofjax.extraction.observation import Observation
    from sofjax.io.drive import Drive
    from sofjax.vision import Frontend

SHOWN = 6  # images in the figure
DOUBTFUL = 3  # exit code: all was read, and a run on it would mislead


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "inspect",
        help="say what is in a drive and whether it can be right, and draw its segments",
        description="Say what is in a drive, and draw the segments of a few of its images.",
    )
    parser.add_argument("drive", metavar="DRIVE", type=Path, help="folder of the drive")
    parser.add_argument(
        "--out", metavar="FILE", type=Path, help="the figure; default: runs/<drive>-inspect.png"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Read, search all images, judge, draw."""
    import sys

    from sofjax import viewer
    from sofjax.io.drive import read_drive
    from sofjax.pipeline import run_folder, setup_checks
    from sofjax.slam.presets import PRESETS
    from sofjax.vision import Frontend

    drive = read_drive(args.drive)
    frontend = Frontend.of(drive)
    out = args.out or Path("runs") / f"{drive.name}-inspect.png"
    run_folder.check_figure(out)
    run_folder.check_writable(out.parent)
    seen = look(drive, frontend)
    print(describe(drive, seen))
    drive = dataclasses.replace(drive, remarks=drive.remarks + frontend.remarks)
    warnings = setup_checks.of_drive(drive)
    warnings += [f"{len(files)} images {fault}" for fault, files in seen.faults.items()]
    wrong = drive.contradictions + setup_checks.set_up(PRESETS["default"], drive, seen.log)
    warnings += [doubt for doubt in wrong if doubt not in warnings]
    for warning in warnings:
        print(f"  warning   {warning}")
    print(f"  verdict   {verdict(warnings, wrong)}")
    if viewer.available():
        draw(out, drive, frontend, seen)
        print(f"drawn to {out}")
    else:
        print(f"sofjax: {viewer.MISSING}", file=sys.stderr)
    return DOUBTFUL if wrong else 0


def verdict(warnings: list[str], wrong: list[str]) -> str:
    """What the drive is worth, in a line."""
    if wrong:
        return "doubtful: a run on it would mislead; see the warnings"
    return "usable: see the warnings" if warnings else "good"


@dataclass
class Seen:
    """What the images of a drive show, by the odometer's motion alone."""

    log: "Observation"  # [T]
    faults: dict[str, list[Path]]  # images that tell nothing, by why
    usable: list[bool]  # [T] the others
    segments: int
    on_floor_side: "np.ndarray"  # [T, M] bool
    is_floor: "np.ndarray"  # [T, M] bool, of these, by eq. (9)

    @property
    def below_horizon(self) -> int:
        return int(self.on_floor_side.sum())

    @property
    def associated(self) -> int:
        return int(self.is_floor.sum())


def look(drive: "Drive", frontend: "Frontend") -> Seen:
    """Search all images for segments, and extract SoF along the odometry."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from tqdm import tqdm

    from sofjax.extraction.sof import extract_along
    from sofjax.slam.presets import PRESETS
    from sofjax.vision import observations

    files = tqdm(drive.image_files, desc=drive.name, unit=" images", disable=None)
    faults, usable, segments, log = {}, [], 0, []
    for i, (view, observed) in enumerate(observations(drive, map(frontend.view, files))):
        if view.fault:
            faults.setdefault(view.fault, []).append(drive.image_files[i])
        usable.append(view.readable)
        segments += view.detected
        log.append(observed)
    log = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *log)
    config, file = PRESETS["default"], drive.camera_file
    found, _ = extract_along(
        config.association, file.camera, file.mount, log, config.filter.max_depth
    )
    on_floor_side, is_floor = map(np.asarray, (found.segments_robot.valid, found.is_floor))
    return Seen(log, faults, usable, segments, on_floor_side, is_floor)


def describe(drive: "Drive", seen: Seen) -> str:
    """The drive in a few lines for a person."""
    import numpy as np

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


def _rate(stamps) -> str:
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


def draw(out: Path, drive: "Drive", frontend: "Frontend", seen: Seen) -> None:
    """Draw a few images with their segments, told apart by eq. (9) and the odometer's motion."""
    import numpy as np

    from sofjax import viewer
    from sofjax.vision import read_image

    names, images, floor, other = [], [], [], []
    usable = np.flatnonzero(seen.usable)
    spread = np.linspace(0, len(usable) - 1, SHOWN + 2).round()[1:-1]
    for i in usable[np.unique(spread.astype(int))].tolist():
        file, valid = drive.image_files[i], np.asarray(seen.log.segments_image.valid[i])
        endpoints = np.asarray(seen.log.segments_image.endpoints[i])
        names.append(file.name)
        images.append(frontend.undistort(read_image(file, frontend.bits)))
        floor.append(endpoints[valid & seen.is_floor[i]])
        other.append(endpoints[valid & ~seen.is_floor[i]])
    title = f"{drive.name}: which segments move as the floor does, by eq. (9)"
    viewer.draw_images(out, title, names, images, floor, other)
