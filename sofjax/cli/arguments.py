"""The argument parsers of all commands. Imports nothing that is slow: `--help` answers at once."""

import argparse
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from sofjax.cli import arguments_simulate
from sofjax.pipeline.outcomes import FREE, LOOPS, OF_MOUNT

if TYPE_CHECKING:
    Commands = argparse._SubParsersAction[Any]

QUOTED = 200  # characters of the message of a word that is no option
# vision.boards.PATTERNS, which would take the parser a second to import
PATTERNS = ("chessboard", "circles", "acircles", "charuco")
BY_DEFAULT = "height,pitch,roll"


class _Parser(argparse.ArgumentParser):
    """One that quotes little of what it was given."""

    def error(self, message: str) -> NoReturn:
        super().error(message if len(message) <= QUOTED else f"{message[:QUOTED]}...")


def make_parser() -> argparse.ArgumentParser:
    """The parser of `sofjax`; `command` of what it gives is the command's name."""
    parser = _Parser(
        prog="sofjax", description="Segments-on-floor SLAM: a drive in, a trajectory and a map out."
    )
    parser.add_argument("--version", action="version", version=f"sofjax {version('sofjax')}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for add in (_run, _evaluate, _inspect, _calibrate, arguments_simulate.add, _demo):
        add(commands)
    return parser


def _run(commands: "Commands") -> None:
    parser = commands.add_parser(
        "run",
        help="estimate the trajectory and the map of a drive",
        description="Estimate the trajectory and the map of floor segments of a drive.",
        usage="sofjax run DRIVE [--out DIR] [--particles N] [--seed S] [--detector hough|lsd] "
        "[--calibrate] [--loop none|paper|smooth] [--config FILE] [--set name=value ...]",
    )
    parser.add_argument("drive", metavar="DRIVE", nargs="?", type=Path, help="folder of the drive")
    parser.add_argument("--out", metavar="DIR", type=Path, help="default: runs/<drive>-<time>/")
    parser.add_argument("--particles", metavar="N", type=int, help="size of the filter")
    parser.add_argument("--seed", metavar="S", type=int, help="of the random numbers; default 0")
    # the names of vision.DETECTORS, which the command checks: a user may have added some
    parser.add_argument(
        "--detector", metavar="NAME", help="of the segments in an image, such as hough or lsd"
    )
    parser.add_argument(
        "--calibrate",
        action="store_true",
        help="first fit mount, lens, clock and odometer to the drive, as `calibrate robot` does",
    )
    parser.add_argument(
        "--loop",
        choices=LOOPS,
        help="after the drive: nothing, the paper's closing, or all poses and lines solved at once",
    )
    parser.add_argument("--config", metavar="FILE", type=Path, help="settings as TOML")
    parser.add_argument(
        "--set",
        metavar="name=value",
        dest="sets",
        nargs="+",
        action="extend",
        default=[],
        help="change settings, such as motion.distance_noise=0.02 or preset=paper",
    )
    parser.set_defaults(command="run", parser=parser)


def _evaluate(commands: "Commands") -> None:
    parser = commands.add_parser(
        "evaluate",
        help="compare a run with the truth",
        description="Compare the trajectory and the map of a run with the truth of its drive.",
    )
    parser.add_argument("folder", metavar="RUN_DIR", type=Path, help="folder of the run")
    parser.add_argument(
        "drive", metavar="DRIVE", nargs="?", type=Path, help="default: the drive of the report"
    )
    parser.set_defaults(command="evaluate")


def _inspect(commands: "Commands") -> None:
    parser = commands.add_parser(
        "inspect",
        help="say what is in a drive and whether it can be right, and draw its segments",
        description="Say what is in a drive, and draw the segments of a few of its images.",
    )
    parser.add_argument("drive", metavar="DRIVE", type=Path, help="folder of the drive")
    parser.add_argument(
        "--out", metavar="FILE", type=Path, help="the figure; default: runs/<drive>-inspect.png"
    )
    parser.set_defaults(command="inspect")


def _calibrate(commands: "Commands") -> None:
    parser = commands.add_parser(
        "calibrate",
        help="find what the camera is, and where it sits",
        description="Find what the camera is, and where it sits on the robot.",
    )
    parts = parser.add_subparsers(title="what to calibrate", metavar="WHAT", required=True)
    _calibrate_camera(parts)
    _calibrate_robot(parts)
    _calibrate_mount(parts)


def _calibrate_camera(parts: "Commands") -> None:
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
    _add_out(
        parser,
        "the camera file; default camera.yaml. Mount, clock and odometer that it has already are "
        "kept, and a figure is drawn beside it. Files that sofjax has not written are not replaced",
    )
    parser.add_argument(
        "--mount",
        metavar="height=0.6,pitch=0.26,...",
        help="where the camera sits on the robot, as measured; metres and radians",
    )
    parser.set_defaults(command="calibrate camera")


def _calibrate_robot(parts: "Commands") -> None:
    parser = parts.add_parser(
        "robot",
        help="mount, lens, clock and odometer from a drive, as far as it tells them",
        description="Fit to a drive what it tells of the robot: the camera's height and tilt, and, "
        "where the images contradict what the camera file says, its yaw and lever arm, its focal "
        "length, centre and lens, and the offset of its clock. Some metres over a floor with lines "
        "across the way, with straight parts and turns both ways.",
    )
    _add_drive_fit(parser)
    parser.add_argument(
        "--free",
        metavar="height,focal,...",
        help=f"what to fit in any case, of {', '.join(FREE)}; default: {BY_DEFAULT}, the "
        "odometer's errors in turning, and what the drive contradicts of the others, but for the "
        "line delay, which wants turns at several speeds, and the distance, which is the measure",
    )
    parser.set_defaults(command="calibrate robot", joint=False, robot=True)


def _calibrate_mount(parts: "Commands") -> None:
    parser = parts.add_parser(
        "mount",
        help="the camera's height and tilt alone from a drive",
        description="Fit where the camera sits on the robot to what it sees on a drive: some "
        "metres over a floor with lines across the way, with straight parts.",
    )
    _add_drive_fit(parser)
    parser.add_argument(
        "--free",
        metavar="height,pitch,...",
        default=BY_DEFAULT,
        help=f"what to fit, of {', '.join(OF_MOUNT)} (the last four are "
        f"the odometer's errors, and those in turning are always free); default {BY_DEFAULT}",
    )
    parser.add_argument(
        "--joint",
        action="store_true",
        help="then solve all poses, lines, their heights and the mount together",
    )
    parser.set_defaults(command="calibrate mount", robot=False)


def _add_drive_fit(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("drive", metavar="DRIVE", type=Path, help="folder of the drive")
    parser.add_argument(
        "--initial",
        metavar="height=1.0,pitch=0.2,...",
        help="where to begin, metres and radians, in the place of what the camera file says; "
        "30 %% and 8 degrees off will do",
    )
    _add_out(
        parser,
        "the camera file to write; default camera.yaml. A figure is drawn beside it. "
        "Files that sofjax has not written are not replaced",
    )


def _add_out(parser: argparse.ArgumentParser, what: str) -> None:
    default = Path("camera.yaml")
    parser.add_argument("-o", "--out", metavar="FILE", type=Path, default=default, help=what)


def _demo(commands: "Commands") -> None:
    parser = commands.add_parser(
        "demo",
        help="make a drive, run on it and show what came out",
        description="Make a drive through a corridor like the paper's, estimate its path and its "
        "map, and write a page that explains both. Takes about a minute.",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, help="default: runs/demo-<time>/")
    parser.add_argument(
        "--world", metavar="NAME", default="paper", help=arguments_simulate.WORLD_HELP
    )
    parser.add_argument("--seed", metavar="S", type=int, default=3, help="of the world; default 3")
    parser.set_defaults(command="demo")
