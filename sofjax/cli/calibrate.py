"""`sofjax calibrate`: what the camera is, and where it sits."""

import argparse

from sofjax.cli import calibrate_camera


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "calibrate",
        help="find the camera's intrinsics",
        description="Find what the camera is.",
    )
    parts = parser.add_subparsers(title="what to calibrate", metavar="WHAT", required=True)
    for part in (calibrate_camera,):
        part.add_parser(parts)
