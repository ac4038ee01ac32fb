"""`sofjax simulate`: a drive of a made-up robot through a made-up corridor."""

import argparse
import dataclasses
import re
from collections.abc import Iterable
from typing import TYPE_CHECKING

from sofjax.io.errors import InputError, nearest, quoted
from sofjax.io.numbers import decimal

if TYPE_CHECKING:
    import numpy as np

    from sofjax.simulation import Imaging, RobotSetup

USUAL_SIZE = 320, 240  # pixels
SMALLEST, LARGEST = (32, 24), (4096, 4096)  # pixels
FOCAL = 0.2, 20.0  # widths of the image
LARGEST_TURN, LARGEST_OTHER = 180, 90  # degrees of roll and yaw; degrees of pitch and metres
NEAREST = 0.1  # metres between waypoints


def run(args: argparse.Namespace) -> int:
    """Make the world, drive, draw, write."""
    if args.seed < 0:
        raise InputError(f"--seed is {args.seed}; it must be 0 or more")
    if args.images is not None and args.images < 2:
        raise InputError(f"--images is {args.images}; a drive needs 2 at least")
    from tqdm import tqdm

    from sofjax.simulation import make_world, record, simulate_run

    world = make_world(args.world, args.seed)
    if args.way is not None:
        world = dataclasses.replace(world, waypoints=_way(args.way))
    setup, imaging = choose_setup(args), _imaging(args)
    simulated = simulate_run(world, setup, args.seed, args.images)

    def progress(frames: Iterable) -> Iterable:
        return tqdm(frames, desc=args.out.name, unit=" images", disable=None)

    record(args.out, world, setup, simulated, imaging, args.seed, progress)
    path, seconds = simulated.truth.travelled[-1], simulated.truth.stamps[-1]
    print(f"{args.out}: {len(simulated.truth.stamps)} images, {path:.1f} m in {seconds:.1f} s")
    return 0


def choose_setup(args: argparse.Namespace) -> "RobotSetup":
    """The robot that the options ask for: the paper's, or in a random world a random one."""
    import equinox as eqx
    import jax.numpy as jnp
    import numpy as np

    from sofjax.simulation import RobotSetup, random_setup, webcam

    setup = random_setup(args.seed) if args.world == "random" else RobotSetup()
    mount = setup.camera_file.mount
    for name in ("height", "pitch", "roll", "yaw", "x", "y"):
        value = getattr(args, name)
        if value is not None:
            if not np.isfinite(value) or abs(value) > _limit(name):
                raise InputError(f"--{name} is {value:g}; that is no place for a camera")
            metric = np.radians(value) if name in ("pitch", "roll", "yaw") else value
            mount = eqx.tree_at(
                lambda m, name=name: getattr(m, name), mount, jnp.asarray(metric, float)
            )
    width, height = _size(args.size)
    usual = float(setup.camera_file.camera.K[0, 0]) * width / USUAL_SIZE[0]
    focal = usual if args.focal is None else args.focal
    least, most = (share * width for share in FOCAL)
    if not least <= focal <= most:
        raise InputError(
            f"--focal is {focal:g} px; for {width} pixels it must be {least:g} or more"
        )
    distortion = setup.camera_file.distortion
    if args.distortion is not None:
        distortion = args.distortion
        if len(distortion) not in (4, 5) or not np.isfinite(distortion).all():
            raise InputError("--distortion must be 4 or 5 finite numbers, k1 k2 p1 p2 k3")
    given = {
        "vibration": None if args.vibration is None else np.radians(args.vibration),
        "dropped": args.dropped,
    }
    driven = {"speed": args.speed, "jitter": args.jitter}
    return dataclasses.replace(
        setup,
        camera_file=webcam(mount, focal, width, height, distortion),
        driver=dataclasses.replace(setup.driver, **_chosen(driven)),
        odometer=dataclasses.replace(setup.odometer, **_odometer(args.odometer)),
        **_chosen(given),
    )


def _limit(name: str) -> int | float:
    """The largest value of a mount's field, metres or degrees."""
    return LARGEST_TURN if name in ("roll", "yaw") else LARGEST_OTHER


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
        return USUAL_SIZE
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(re.fullmatch("[0-9]{1,9}", part) for part in parts):
        raise InputError(f"--size is {quoted(text)}; it must be like 640x480")
    width, height = map(int, parts)
    if not (SMALLEST[0] <= width <= LARGEST[0] and SMALLEST[1] <= height <= LARGEST[1]):
        raise InputError(f"--size is {quoted(text)}; it must be from 32x24 to 4096x4096")
    return width, height


def _way(text: str) -> "np.ndarray":
    import numpy as np

    points = [_numbers("--way", point) for point in text.split()]
    if len(points) < 2 or any(len(point) != 2 for point in points):
        raise InputError("--way must be two points 'x,y x,y' or more, in metres")
    way = np.array(points)
    if (np.linalg.norm(np.diff(way, axis=0), axis=1) < NEAREST).any():
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
