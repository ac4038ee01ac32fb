"""`sofjax calibrate camera`: intrinsics from views of a board."""

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from sofjax.io.errors import InputError

if TYPE_CHECKING:
    from sofjax.vision.boards import Board
    from sofjax.vision.checkerboard import CameraFit, Verdict

# vision.boards.PATTERNS, which would take the parser a second to import
PATTERNS = ("chessboard", "circles", "acircles", "charuco")
REFUSED = 3  # exit code: all was read, and nothing can be known from it


def add_parser(parts: argparse._SubParsersAction) -> None:
    parser = parts.add_parser(
        "camera",
        help="focal length, centre and lens from images of a checkerboard",
        description="Find focal length, centre and distortion from images of a checkerboard, a "
        "grid of circles or a ChArUco board. 15 to 20 images do, near and tilted, that reach every "
        "corner of the view. Who has a calibration of ROS, OpenCV or Kalibr for the camera needs "
        "none: it does as camera.yaml with a mount added at its end, such as "
        "'mount: {height: 0.6, pitch: 0.26}'.",
    )
    parser.add_argument(
        "images", metavar="IMAGES", nargs="+", type=Path, help="a folder of images, or files"
    )
    parser.add_argument(
        "--board",
        metavar="9x6",
        required=True,
        help="inner corners along and across: a board of 10x7 squares has 9x6; with circles those "
        "of a row and the rows, with charuco the squares",
    )
    parser.add_argument(
        "--square",
        metavar="M",
        type=float,
        required=True,
        help="side of a square, metres; with circles from one to the next, with acircles from row "
        "to row",
    )
    parser.add_argument(
        "--pattern",
        choices=PATTERNS,
        default=PATTERNS[0],
        help="what is on the board: circles in a square grid, or (acircles) with every other row "
        "half a step aside; default chessboard",
    )
    parser.add_argument(
        "--marker", metavar="M", type=float, help="side of a charuco board's markers, metres"
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
    from sofjax.cli import board_images
    from sofjax.io.camera_file import known_mount, mount_fields
    from sofjax.pipeline import run_folder
    from sofjax.vision.checkerboard import fit_camera, judge

    board = board_images.board(args)
    if args.out.is_dir():
        raise InputError(f"{args.out}: is a folder; -o must name a file, such as camera.yaml")
    figure = args.out.with_suffix(".png")
    run_folder.check_camera(args.out)
    run_folder.check_figure(figure)
    mount = known_mount(args.out) if args.out.exists() else {}
    mount |= mount_fields("--mount", args.mount) if args.mount is not None else {}
    found = board_images.look(board_images.files(args.images), board)
    run_folder.check_writable(args.out.parent)
    try:
        fit = fit_camera(board, found.width, found.height, found.names, found.views)
    except ValueError as error:
        print(f"not usable: {error}; take 15 to 20, tilted by 30° and more")
        print(f"{args.out} is not written")
        return REFUSED
    board, verdict = found.board, judge(fit)
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
            [view.corners for view in fit.views],
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
        f"{fit.width}x{fit.height} used, board {board} of {1e3 * board.square:g} mm"
        + f", markers of {board.dictionary}"
        * bool(board.dictionary),
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
