"""`sofjax calibrate camera`: intrinsics from views of a board."""

import argparse
import dataclasses
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

from sofjax.cli import summaries
from sofjax.cli.progress import bar
from sofjax.io.errors import InputError, quoted

if TYPE_CHECKING:
    from sofjax.io.camera_file import RigFields
    from sofjax.vision.boards import Board
    from sofjax.vision.checkerboard import CameraFit, Verdict

MAX_CORNERS = 60  # along a side
REFUSED = 3  # exit code: all was read, and nothing can be known from it


def run(args: argparse.Namespace) -> int:
    """Find the corners, fit, judge, print, write, draw."""
    from sofjax import viewer
    from sofjax.io.camera_file import RigFields, known_mount, known_rig_fields, mount_fields
    from sofjax.pipeline import board_images, run_folder
    from sofjax.vision.checkerboard import fit_camera, judge

    board = board_of(args)
    if args.out.is_dir():
        raise InputError(f"{args.out}: is a folder; -o must name a file, such as camera.yaml")
    figure = args.out.with_suffix(".png")
    run_folder.check_camera(args.out)
    run_folder.check_figure(figure)
    mount = known_mount(args.out) if args.out.exists() else {}
    fields = known_rig_fields(args.out) if args.out.exists() else RigFields()
    mount |= mount_fields("--mount", args.mount) if args.mount is not None else {}
    files = board_images.files(args.images)
    with bar(len(files), board.things) as progress:
        found = board_images.look(files, board, progress)
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
        _write(args.out, board, fit, mount, fields)
    else:
        print(f"{args.out} is not written")
    if viewer.available():
        _draw(figure, board, fit, verdict, found.names)
        print(f"drawn to {figure}")
    else:
        print(viewer.MISSING)
    if verdict.usable:
        print(summaries.next_command("calibrate robot", put=args.out))
    return 0 if verdict.usable else REFUSED


def board_of(args: argparse.Namespace) -> "Board":
    """The board of --pattern, --board, --square and --marker, checked."""
    from sofjax.pipeline.board_images import MIN_CORNERS
    from sofjax.vision.boards import Board

    sides = args.board.lower().replace("×", "x").split("x")
    what = {"chessboard": "inner corners", "charuco": "squares"}.get(args.pattern, "circles")
    if len(sides) != 2 or not all(re.fullmatch(" *[0-9]{1,9} *", side) for side in sides):
        raise InputError(
            f"--board is {quoted(args.board)}; it must be the {what} along and across, like 9x6"
        )
    columns, rows = map(int, sides)
    if not (MIN_CORNERS <= min(columns, rows) and max(columns, rows) <= MAX_CORNERS):
        raise InputError(
            f"--board is {quoted(args.board)}; each side must have from {MIN_CORNERS} to "
            f"{MAX_CORNERS} {what}"
        )
    if not 0 < args.square <= 1:  # also what is no number
        raise InputError(
            f"--square is {args.square:g}; it must be the side of a square in metres, such as 0.03"
        )
    if args.pattern != "charuco":
        if args.marker is not None:
            raise InputError("--marker goes with --pattern charuco alone; leave it out")
        return Board(columns, rows, args.square, args.pattern)
    if args.marker is None or not 0 < args.marker < args.square:
        given = "missing" if args.marker is None else f"{args.marker:g}"
        raise InputError(
            f"--marker is {given}; it must be the side of a charuco board's markers in metres, "
            "less than --square"
        )
    return Board(columns, rows, args.square, args.pattern, args.marker)


def _draw(
    path: Path, board: "Board", fit: "CameraFit", verdict: "Verdict", names: list[str]
) -> None:
    from sofjax import viewer

    used = [view.used for view in fit.views]
    viewer.draw_corners(
        path,
        f"{sum(used)} of {len(used)} views of a {board} board used: {verdict.word}",
        (fit.width, fit.height),
        [view.corners for view in fit.views],
        [view.residuals for view in fit.views],
        used,
        names,
    )


def _write(
    path: Path, board: "Board", fit: "CameraFit", mount: dict[str, float], fields: "RigFields"
) -> None:
    """The camera file, with clock and odometer as they stood in it, and what it still wants."""
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
    fields = dataclasses.replace(fields, sigma={**fields.sigma, **known_to(fit)})
    write_intrinsics(path, camera, "plumb_bob", distortion, name, mount, notes, fields)
    print(f"written to {path}")
    if missing:
        print(f"before a run, fill in the {' and the '.join(missing)} of its mount")


def known_to(fit: "CameraFit") -> dict[str, float]:
    """Standard deviations of what `calibrate robot` may fit anew, in its units."""
    fx, _, cx, cy = fit.intrinsics_sigma
    f = fit.intrinsics[0]
    k1, k2, *_ = fit.distortion_sigma
    sigma = {"focal": fx / f, "cx": cx / f, "cy": cy / f, "k1": k1, "k2": k2}
    return {name: float(f"{value:.3g}") for name, value in sigma.items() if value > 0}


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
