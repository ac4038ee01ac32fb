"""`sofjax calibrate camera`: intrinsics from views of a checkerboard."""

import argparse
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sofjax.io.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from sofjax.vision.checkerboard import Board, CameraFit, Verdict

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"}
MIN_CORNERS, MAX_CORNERS = 3, 60  # along a side
REFUSED = 3  # exit code: all was read, and nothing can be known from it


def add_parser(parts: argparse._SubParsersAction) -> None:
    parser = parts.add_parser(
        "camera",
        help="focal length, centre and lens from images of a checkerboard",
        description="Find focal length, centre and distortion from images of a checkerboard. "
        "15 to 20 images do, near and tilted, that reach every corner of the view.",
    )
    parser.add_argument(
        "images", metavar="IMAGES", nargs="+", type=Path, help="a folder of images, or files"
    )
    parser.add_argument(
        "--board",
        metavar="9x6",
        required=True,
        help="inner corners along and across: a board of 10x7 squares has 9x6",
    )
    parser.add_argument(
        "--square", metavar="M", type=float, required=True, help="side of a square, metres"
    )
    parser.add_argument(
        "-o",
        "--out",
        metavar="FILE",
        type=Path,
        default=Path("camera.yaml"),
        help="the camera file; default camera.yaml. The mount that it has already is kept, and a "
        "figure is drawn beside it. Files that sofjax has not written are not replaced",
    )
    parser.add_argument(
        "--mount",
        metavar="height=0.6,pitch=0.26,...",
        help="where the camera sits on the robot, as measured; metres and radians",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Find the corners, fit, judge, draw, write."""
    from sofjax import viewer
    from sofjax.cli import outputs
    from sofjax.io.camera_file import known_mount, mount_fields
    from sofjax.vision.checkerboard import fit_camera, judge

    board = _board(args.board, args.square)
    if args.out.is_dir():
        raise InputError(f"{args.out}: is a folder; -o must name a file, such as camera.yaml")
    figure = args.out.with_suffix(".png")
    outputs.check_camera(args.out)
    outputs.check_figure(figure)
    mount = known_mount(args.out) if args.out.exists() else {}
    mount |= mount_fields("--mount", args.mount) if args.mount is not None else {}
    found = _look(_image_files(args.images), board)
    outputs.check_writable(args.out.parent)
    try:
        fit = fit_camera(board, found.width, found.height, found.names, found.corners)
    except ValueError as error:
        print(f"not usable: {error}; take 15 to 20, tilted by 30° and more")
        print(f"{args.out} is not written")
        return REFUSED
    verdict = judge(fit)
    print(summary(board, fit, verdict, found.left_out))
    if verdict.usable:
        _write(args.out, board, fit, mount)
    else:
        print(f"{args.out} is not written")
    if viewer.available():
        used = [view.used for view in fit.views]
        viewer.draw_corners(
            figure,
            f"{sum(used)} of {len(used)} views of a {board} board used: {verdict.word}",
            (fit.width, fit.height),
            found.corners,
            [view.residuals for view in fit.views],
            used,
            found.names,
        )
        print(f"drawn to {figure}")
    else:
        print(viewer.MISSING)
    return 0 if verdict.usable else REFUSED


def _write(path: Path, board: "Board", fit: "CameraFit", mount: dict) -> None:
    """The camera file, and what it still wants."""
    import jax.numpy as jnp

    from sofjax.geometry import Camera
    from sofjax.io.camera_file import TO_FILL_IN, check_floor_in_view, write_intrinsics

    missing = [key for key in TO_FILL_IN if key not in mount]
    if not missing:
        check_floor_in_view(f"{path}", fit.K, fit.width, fit.height, {"roll": 0.0} | mount)
    camera = Camera(jnp.asarray(fit.K, float), fit.width, fit.height)
    views = sum(view.used for view in fit.views)
    notes = [f"from {views} views of a {board} board", *numbers(fit)]
    distortion = fit.distortion.round(7)
    name = path.resolve().parent.name  # as a camera without a name is called
    write_intrinsics(path, camera, "plumb_bob", distortion, name, mount, notes)
    print(f"written to {path}")
    if missing:
        print(f"before a run, fill in the {' and the '.join(missing)} of its mount")


def numbers(fit: "CameraFit") -> list[str]:
    """What was fitted, each with its standard deviation."""
    from sofjax.vision.checkerboard import TERMS

    fx, fy, cx, cy = (
        f"{v:.2f} ± {s:.2f}" for v, s in zip(fit.intrinsics, fit.intrinsics_sigma, strict=True)
    )
    terms = [
        f"{term} {v:.4f} ± {s:.4f}" if s else f"{term} 0"
        for term, v, s in zip(TERMS, fit.distortion, fit.distortion_sigma, strict=True)
    ]
    return [
        f"focal     {fx} and {fy} px",
        f"centre    {cx} and {cy} px",
        f"lens      {', '.join(terms)}",
        f"residual  {fit.error:.3f} px, root mean square of the corners",
    ]


def summary(board: "Board", fit: "CameraFit", verdict: "Verdict", left_out: dict[str, str]) -> str:
    """The fit for a person: every view, the numbers, what they are worth."""
    usual = sorted(view.error for view in fit.views if view.used)
    usual = usual[len(usual) // 2]
    lines = [
        f"{sum(view.used for view in fit.views)} of {len(fit.views) + len(left_out)} images of "
        f"{fit.width}x{fit.height} used, board {board} of {1e3 * board.square:g} mm",
    ]
    for view in fit.views:
        line = (
            f"  {view.name:20} {view.error:6.3f} px  {view.distance:5.2f} m  "
            f"tilted {math.degrees(view.tilt):2.0f}°"
        )
        if not view.used:
            line += f"  left out: {view.error / usual:.0f} times the others' error"
        lines.append(line)
    lines += [f"  {name:20} left out: {why}" for name, why in left_out.items()]
    lines += [f"  {line}" for line in numbers(fit)]
    return "\n".join([*lines, f"  verdict   {verdict.sentence}"])


@dataclass(frozen=True)
class Found:
    """What the images show."""

    width: int  # pixels
    height: int
    names: list[str]  # images in which the board was found
    corners: list["np.ndarray"]  # [N, 2] of each
    left_out: dict[str, str]  # the other images, and why


def _look(files: list[Path], board: "Board") -> Found:
    """Search every image for the board, one at a time."""
    from tqdm import tqdm

    from sofjax.vision import read_image
    from sofjax.vision.checkerboard import MIN_VIEWS, find_corners

    first, names, corners, left_out = None, [], [], {}
    for file in tqdm(files, desc="corners", unit=" images", disable=None):
        image = read_image(file)
        if image is None:
            left_out[file.name] = "cannot be read as an image"
            continue
        first = first or (file, image.shape)
        if image.shape != first[1]:
            raise InputError(
                f"{file}: has {_by(image.shape)} pixels and {first[0].name} {_by(first[1])}; all "
                "images must be of one size, that of the drives"
            )
        found = find_corners(image, board)
        if found is None:
            left_out[file.name] = (
                f"no {board} corners found: is the whole board in view, sharp and not too steep?"
            )
        else:
            names.append(file.name)
            corners.append(found)
    if first is None:
        raise InputError(f"{files[0].parent}: none of the {len(files)} images can be read")
    if len(names) < MIN_VIEWS:
        raise InputError(
            f"{files[0].parent}: the {board} corners were found in {len(names)} of {len(files)} "
            f"images, and {MIN_VIEWS} are needed at least; {_hint(files, board)}"
        )
    height, width = first[1]
    return Found(width, height, names, corners, left_out)


def _hint(files: list[Path], board: "Board") -> str:
    """Which other board it might be: squares were counted, or one side wrongly."""
    from sofjax.vision import read_image
    from sofjax.vision.checkerboard import Board, find_corners

    images = [image for image in map(read_image, files[:4]) if image is not None]
    for columns, rows in ((-1, -1), (-2, -2), (0, -1), (-1, 0)):
        other = Board(board.columns + columns, board.rows + rows, board.square)
        if min(other.columns, other.rows) < MIN_CORNERS:
            continue
        if all(find_corners(image, other) is not None for image in images):
            return f"with --board {other} they are found"
    return "--board counts inner corners, and the whole board must be in view, with a white rim"


def _image_files(given: list[Path]) -> list[Path]:
    """The images of a folder in the order of their names, or the files themselves."""
    files = []
    for path in given:
        if not path.exists():
            raise InputError(f"{path}: there is no such file or folder of images")
        try:
            inside = sorted(path.iterdir()) if path.is_dir() else [path]
        except OSError as error:
            raise InputError(f"{path}: the folder cannot be read ({error.strerror})") from None
        images = [file for file in inside if file.suffix.lower() in SUFFIXES and file.is_file()]
        if not images:
            known = ", ".join(sorted(SUFFIXES))
            raise InputError(f"{path}: no image there; images end in {known}")
        files += images
    return files


def _board(text: str, square: float) -> "Board":
    from sofjax.vision.checkerboard import Board

    sides = text.lower().replace("×", "x").split("x")
    if len(sides) != 2 or not all(side.strip().isdecimal() for side in sides):
        raise InputError(
            f"--board is '{text:.40}'; it must be the inner corners along and across, like 9x6"
        )
    columns, rows = map(int, sides)
    if not (MIN_CORNERS <= min(columns, rows) and max(columns, rows) <= MAX_CORNERS):
        raise InputError(
            f"--board is '{text:.40}'; each side must have from {MIN_CORNERS} to {MAX_CORNERS} "
            "inner corners"
        )
    if not 0 < square <= 1:  # also what is no number
        raise InputError(
            f"--square is {square:g}; it must be the side of a square in metres, such as 0.03"
        )
    return Board(columns, rows, square)


def _by(shape: tuple[int, int]) -> str:
    return f"{shape[1]}x{shape[0]}"
