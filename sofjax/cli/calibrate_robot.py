"""`sofjax calibrate robot` and `mount`: what a drive tells of camera, mount, clock and wheels."""

import argparse
import dataclasses
from typing import TYPE_CHECKING

from sofjax.cli import summaries
from sofjax.cli.arguments import BY_DEFAULT
from sofjax.cli.progress import bar
from sofjax.io.errors import InputError, nearest, quoted
from sofjax.pipeline.outcomes import FREE, OF_MOUNT, OF_RIG

if TYPE_CHECKING:
    from sofjax.io.drive import Drive

REFUSED = 3  # exit code: all was read, and nothing can be known from it


def run(args: argparse.Namespace) -> int:
    """Read, fit, print, write, draw."""
    from sofjax import viewer
    from sofjax.io.drive import read_drive
    from sofjax.pipeline import calibrate_drive, figures, run_folder
    from sofjax.pipeline.calibrate import IF_TOLD

    free = free_names(BY_DEFAULT if args.free is None else args.free, args.robot)
    if args.joint and "distance" in free:
        raise InputError("--joint keeps the odometer's distances; leave 'distance' out of --free")
    if args.out.is_dir():
        raise InputError(f"{args.out}: is a folder; -o must name a file, such as camera.yaml")
    figure = args.out.with_suffix(".png")
    run_folder.check_camera(args.out)
    run_folder.check_figure(figure)
    drive = begin_at(read_drive(args.drive), args.initial)
    run_folder.check_writable(args.out.parent)
    with bar(len(drive.image_files), "segments") as progress:
        found = calibrate_drive(
            drive, free=free, joint=args.joint, progress=progress,
            more=IF_TOLD if args.free is None else (), robot=args.robot,
        )  # fmt: skip
    print(summaries.of_calibration(found))
    if found.usable:
        found.write(args.out)
        print(f"written to {args.out}")
    else:
        print(f"{args.out} is not written")
    if not viewer.available():
        print(viewer.MISSING)
    elif figures.draw_calibration(figure, found):
        print(f"drawn to {figure}")
    if found.usable:
        print(summaries.next_command("run", args.drive, put=args.out))
    return 0 if found.usable else REFUSED


def free_names(text: str, robot: bool = False) -> tuple[str, ...]:
    """The names of --free, checked: those of `calibrate robot` or of `calibrate mount`."""
    known, some = (FREE, OF_RIG) if robot else (OF_MOUNT, OF_MOUNT[:4])
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",")))
    for name in names:
        if name not in known:
            raise InputError(f"--free: there is no {quoted(name)}; {nearest(name, known)}")
    if not set(names) & set(some):
        few = ", ".join(some[:-1])
        raise InputError(f"--free: one of {few} and {some[-1]} at least must be free")
    return names


def begin_at(drive: "Drive", initial: str | None) -> "Drive":
    """The drive with some of its mount's fields as the user gives them."""
    import jax.numpy as jnp
    import numpy as np

    from sofjax.io.camera_file import check_floor_in_view, mount_fields

    if initial is None:
        return drive
    given = mount_fields("--initial", initial)
    camera, mount = drive.camera_file.camera, drive.camera_file.mount
    values = {f.name: getattr(mount, f.name) for f in dataclasses.fields(mount)}
    values |= {key: jnp.asarray(value, float) for key, value in given.items()}
    K = np.asarray(camera.K, float)
    plain = {key: float(value) for key, value in values.items()}
    check_floor_in_view("--initial", K, camera.width, camera.height, plain)
    file = dataclasses.replace(drive.camera_file, mount=type(mount)(**values))
    return dataclasses.replace(drive, camera_file=file)
