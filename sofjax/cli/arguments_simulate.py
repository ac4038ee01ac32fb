"""The arguments of `sofjax simulate`."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    Commands = argparse._SubParsersAction[Any]

WORLD_HELP = "paper, l, t, eight or random; default paper"


def add(commands: "Commands") -> None:
    """Add the command."""
    parser = commands.add_parser(
        "simulate",
        help="make a drive through a corridor, with exact truth",
        description="Make a drive: a robot is driven by hand through a corridor, and its camera's "
        "images, its odometry and the truth are written as a drive's folder.",
    )
    parser.add_argument("--out", metavar="DRIVE", type=Path, required=True, help="a new folder")
    parser.add_argument("--world", metavar="NAME", default="paper", help=WORLD_HELP)
    parser.add_argument(
        "--seed", metavar="S", type=int, default=0, help="of the look, the drive and the "
        "noise; in the world 'random' also of the plan, the camera and the odometer"
    )  # fmt: skip
    parser.add_argument(
        "--way",
        metavar="'x,y x,y ...'",
        help="points to drive along instead of the world's own, metres",
    )
    parser.add_argument("--images", metavar="N", type=int, help="stop after so many")
    _add_mount(parser)
    _add_camera(parser)
    _add_robot(parser)
    parser.set_defaults(command="simulate")


def _add_mount(parser: argparse.ArgumentParser) -> None:
    mount = parser.add_argument_group("the camera on the robot")
    for name, unit, what in (
        ("height", "M", "metres above the floor; default 1"),
        ("pitch", "DEG", "degrees that it looks down; default 12"),
        ("roll", "DEG", "degrees; default 0"),
        ("yaw", "DEG", "degrees to the left; default 0"),
        ("x", "M", "metres before the axle; default 0.1"),
        ("y", "M", "metres left of the middle; default 0"),
    ):
        mount.add_argument(f"--{name}", metavar=unit, type=float, help=what)


def _add_camera(parser: argparse.ArgumentParser) -> None:
    camera = parser.add_argument_group("the camera")
    camera.add_argument("--size", metavar="WxH", help="pixels; default 320x240")
    camera.add_argument("--focal", metavar="PX", type=float, help="pixels; default 291 at 320x240")
    camera.add_argument(
        "--distortion",
        metavar="k",
        nargs="+",
        type=float,
        help="k1 k2 p1 p2 k3 as OpenCV's plumb_bob",
    )
    camera.add_argument("--noise", metavar="GREY", type=float, help="grey values; default 2.5")
    camera.add_argument(
        "--blur", metavar="PX", type=float, help="of the lens, pixels; default 0.55"
    )


def _add_robot(parser: argparse.ArgumentParser) -> None:
    robot = parser.add_argument_group("the robot")
    robot.add_argument("--speed", metavar="M/S", type=float, help="metres a second; default 0.7")
    robot.add_argument(
        "--jitter",
        "--wobble",  # its first name
        dest="jitter",
        metavar="RAD/S",
        type=float,
        help="of the hand that steers; default 0.05",
    )
    robot.add_argument("--vibration", metavar="DEG", type=float, help="of the mount; default 0.1")
    robot.add_argument(
        "--dropped", metavar="SHARE", type=float, help="of the readings; default 0.01"
    )
    robot.add_argument(
        "--odometer",
        metavar="name=value",
        nargs="+",
        action="extend",
        default=[],
        help="errors of the odometer: distance, left and right (read / true), bend (rad/m), "
        "distance_noise (m/sqrt(m)), heading_noise (rad/sqrt(m)), turn_noise (rad/sqrt(rad)), "
        "slip (a metre)",
    )
