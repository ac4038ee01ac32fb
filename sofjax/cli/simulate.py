"""`sofjax simulate`: a drive of a made-up robot through a made-up corridor."""

import argparse
import dataclasses
import re
from pathlib import Path
from typing import TYPE_CHECKING

from sofjax.io.errors import InputError, nearest, quoted
from sofjax.io.numbers import decimal

if TYPE_CHECKING:
    import numpy as np

    from sofjax.simulation import Imaging, Rig

WORLD_HELP = "paper, l, t, eight or random; default paper"


def add_parser(commands: argparse._SubParsersAction) -> None:
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
    robot = parser.add_argument_group("the robot")
    robot.add_argument("--speed", metavar="M/S", type=float, help="metres a second; default 0.7")
    robot.add_argument("--wobble", metavar="RAD/S", type=float, help="of the hand; default 0.05")
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
    parser.set_defaults(run=run, parser=parser)


def run(args: argparse.Namespace) -> int:
    """Make the world, drive, draw, write."""
    if args.seed < 0:
        raise InputError(f"--seed is {args.seed}; it must be 0 or more")
    if args.images is not None and args.images < 2:
        raise InputError(f"--images is {args.images}; a drive needs 2 at least")
    from tqdm import tqdm

    from sofjax.simulation import make_world, record, take_ride

    world = make_world(args.world, args.seed)
    if args.way is not None:
        world = dataclasses.replace(world, way=_way(args.way))
    rig, imaging = choose_rig(args), _imaging(args)
    imaging.check()
    ride = take_ride(world, rig, args.seed, args.images)

    def progress(frames: list) -> tqdm:
        return tqdm(frames, desc=args.out.name, unit=" images", disable=None)

    record(args.out, world, rig, ride, imaging, args.seed, progress)
    path, seconds = ride.truth.travelled[-1], ride.truth.stamps[-1]
    print(f"{args.out}: {len(ride.truth.stamps)} images, {path:.1f} m in {seconds:.1f} s")
    return 0


def choose_rig(args: argparse.Namespace) -> "Rig":
    """The robot that the options ask for: the paper's, or in a random world a random one."""
    import equinox as eqx
    import jax.numpy as jnp
    import numpy as np

    from sofjax.simulation import Rig, random_rig, webcam

    rig = random_rig(args.seed) if args.world == "random" else Rig()
    mount = rig.camera_file.mount
    for name in ("height", "pitch", "roll", "yaw", "x", "y"):
        value = getattr(args, name)
        if value is not None:
            if not np.isfinite(value) or abs(value) > (180 if name in ("roll", "yaw") else 90):
                raise InputError(f"--{name} is {value:g}; that is no place for a camera")
            metric = np.radians(value) if name in ("pitch", "roll", "yaw") else value
            mount = eqx.tree_at(
                lambda m, name=name: getattr(m, name), mount, jnp.asarray(metric, float)
            )
    width, height = _size(args.size)
    usual = float(rig.camera_file.camera.K[0, 0]) * width / 320
    focal = usual if args.focal is None else args.focal
    if not 0.2 * width <= focal <= 20 * width:
        raise InputError(
            f"--focal is {focal:g} px; for {width} pixels it must be {0.2 * width:g} or more"
        )
    distortion = rig.camera_file.distortion
    if args.distortion is not None:
        distortion = args.distortion
        if len(distortion) not in (4, 5) or not np.isfinite(distortion).all():
            raise InputError("--distortion must be 4 or 5 finite numbers, k1 k2 p1 p2 k3")
    given = {
        "vibration": None if args.vibration is None else np.radians(args.vibration),
        "dropped": args.dropped,
    }
    driven = {"speed": args.speed, "wobble": args.jitter}
    return dataclasses.replace(
        rig,
        camera_file=webcam(mount, focal, width, height, distortion),
        driver=dataclasses.replace(rig.driver, **_chosen(driven)),
        odometer=dataclasses.replace(rig.odometer, **_odometer(args.odometer)),
        **_chosen(given),
    )


def _chosen(given: dict[str, float | None]) -> dict[str, float]:
    return {name: float(value) for name, value in given.items() if value is not None}


def _imaging(args: argparse.Namespace) -> "Imaging":
    from sofjax.simulation import Imaging

    return Imaging(**_chosen({"noise": args.noise, "blur": args.blur}))


def _odometer(pairs: list[str]) -> dict[str, float]:
    from sofjax.simulation import Odometer

    known = [field.name for field in dataclasses.fields(Odometer)]
    given = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals or name not in known:
            raise InputError(
                f"--odometer {quoted(pair)}: must be name=value; {nearest(name, known)}"
            )
        (given[name],) = _numbers(f"--odometer {name}", value)
    return given


def _size(text: str | None) -> tuple[int, int]:
    if text is None:
        return 320, 240
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(re.fullmatch("[0-9]{1,9}", part) for part in parts):
        raise InputError(f"--size is {quoted(text)}; it must be like 640x480")
    width, height = map(int, parts)
    if not (32 <= width <= 4096 and 24 <= height <= 4096):
        raise InputError(f"--size is {quoted(text)}; it must be from 32x24 to 4096x4096")
    return width, height


def _way(text: str) -> "np.ndarray":
    import numpy as np

    points = [_numbers("--way", point) for point in text.split()]
    if len(points) < 2 or any(len(point) != 2 for point in points):
        raise InputError("--way must be two points 'x,y x,y' or more, in metres")
    way = np.array(points)
    if (np.linalg.norm(np.diff(way, axis=0), axis=1) < 0.1).any():
        raise InputError("--way has two points within 0.1 m of each other; leave one out")
    return way


def _numbers(where: str, text: str) -> list[float]:
    import math

    try:
        numbers = [decimal(word) for word in text.split(",")]
    except ValueError:
        raise InputError(f"{where}: {quoted(text)} must be numbers, with commas between") from None
    if not all(map(math.isfinite, numbers)):
        raise InputError(f"{where}: {quoted(text)} is not finite")
    return numbers
