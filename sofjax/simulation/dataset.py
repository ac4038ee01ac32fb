"""A simulated run, drawn and written as a drive's folder, like those that a robot leaves."""

import os
import secrets
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

from sofjax.io.camera_file import write_camera
from sofjax.io.errors import InputError
from sofjax.io.text import write_atomically
from sofjax.io.trajectory import Trajectory, TrajectoryWriter
from sofjax.simulation.rendering.renderer import WEBCAM, Imaging, Renderer, write_image
from sofjax.simulation.simulate import RobotSetup, SimulatedRun
from sofjax.simulation.world.types import World


def record(
    path: Path,
    world: World,
    setup: RobotSetup,
    simulated: SimulatedRun,
    imaging: Imaging = WEBCAM,
    seed: int = 0,
    progress: Callable[[Iterable], Iterable] = iter,
) -> None:
    """Draw every image of a simulated run and write camera, images, odometry and truth.

    The folder appears when it is complete; `progress` wraps the loop over the images.

    **Raises:** `InputError` if there is such a folder with something in it already.
    """
    path = Path(path).resolve()
    taken = path.exists() and not (path.is_dir() and not any(path.iterdir()))
    if taken or path == Path.cwd():
        raise InputError(f"{path}: is there already; give the drive a folder of its own")
    renderer = Renderer(world, setup.camera_file, imaging, seed)
    beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    try:
        (beside / "rgb").mkdir(parents=True)
    except OSError as error:
        raise InputError(f"{path}: the drive cannot be written there ({error.strerror})") from None
    try:
        _write_tables(beside, world, setup, simulated)
        frames = zip(
            simulated.truth.stamps, *simulated.camera_poses(), simulated.turn_rate, strict=True
        )
        for i, (stamp, R_world_camera, C, turn_rate) in enumerate(progress(list(frames))):
            write_image(beside / _image_name(i), renderer.draw(R_world_camera, C, stamp, turn_rate))
        os.rename(beside, path)  # replaces an empty folder, and nothing else
    except OSError as error:
        error.filename, error.filename2 = str(path), None  # the only path the user knows
        raise
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _image_name(i: int) -> str:
    return f"rgb/{i:06d}.jpg"


def _write_tables(folder: Path, world: World, setup: RobotSetup, simulated: SimulatedRun) -> None:
    write_camera(folder / "camera.yaml", setup.camera_file)
    listed = [f"{stamp:.6f} {_image_name(i)}\n" for i, stamp in enumerate(simulated.truth.stamps)]
    write_atomically(folder / "rgb.txt", "".join(["# timestamp filename\n", *listed]))
    _write_trajectory(folder / "odometry.txt", simulated.odometry)
    _write_trajectory(folder / "groundtruth.txt", simulated.truth)
    truth = world.floor_segments
    rows = ["# true segments on the floor, world frame [m]: x1,y1,x2,y2,kind\n"]
    for ends, kind in zip(truth.endpoints[:, :, :2].reshape(-1, 4), truth.kinds, strict=True):
        rows.append(",".join(f"{value:.4f}" for value in ends) + f",{kind}\n")
    write_atomically(folder / "floor_segments.csv", "".join(rows))


def _write_trajectory(path: Path, trajectory: Trajectory) -> None:
    with TrajectoryWriter(path) as writer:
        for stamp, xy, yaw in zip(trajectory.stamps, trajectory.xy, trajectory.yaw, strict=True):
            writer.write(stamp, xy, yaw)
