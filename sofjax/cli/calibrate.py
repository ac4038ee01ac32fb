"""`sofjax calibrate`: what the camera is, and where it sits."""

import argparse

from sofjax.cli import calibrate_camera, calibrate_mount


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "calibrate",
        help="find what the camera is, and where it sits",
        description="Find what the camera is, and where it sits on the robot.",
    )
    parts = parser.add_subparsers(title="what to calibrate", metavar="WHAT", required=True)
    for part in (calibrate_camera, calibrate_mount):
        part.add_parser(parts)
