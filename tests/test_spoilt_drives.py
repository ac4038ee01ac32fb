"""A drive whose odometry or images are spoilt is followed nearly as well as the clean one."""

import dataclasses
import shutil
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import jit_quickly

from sofjax import SofSlam
from sofjax.cli import main
from sofjax.evaluation import evaluate_trajectory
from sofjax.geometry import SE2
from sofjax.io.drive import motion_sigmas, motions, odometry_warnings, read_drive
from sofjax.io.trajectory import Trajectory
from sofjax.slam.presets import DEFAULT
from sofjax.vision import Frontend, observe_drive

OFFICE = Path(__file__).parent.parent / "examples" / "office"
END = 5.9  # seconds of the sample
CAPACITY = 64


def copy(folder):
    """The first seconds of the sample."""
    folder.mkdir()
    shutil.copy(OFFICE / "camera.yaml", folder)
    shutil.copytree(OFFICE / "rgb", folder / "rgb", copy_function=shutil.copy)
    for name in ("rgb.txt", "odometry.txt", "groundtruth.txt"):
        rows = [row for row in (OFFICE / name).read_text().splitlines() if row[0] != "#"]
        rows = [row for row in rows if float(row.split()[0]) <= END]
        (folder / name).write_text("\n".join(rows) + "\n")
    return folder


@pytest.fixture
def drive(tmp_path):
    return copy(tmp_path / "drive")


@pytest.fixture(scope="module")
def log():
    """What the images show, once for all drives that have them all."""
    drive = read_drive(OFFICE)
    count = int((drive.image_stamps <= END).sum())
    files, stamps = drive.image_files[:count], drive.image_stamps[:count]
    drive = dataclasses.replace(drive, image_files=files, image_stamps=stamps)
    return observe_drive(drive, Frontend(drive.camera_file))


def table(file):
    rows = file.read_text().splitlines()
    return np.array([[float(word) for word in row.split()] for row in rows])


def write(file, rows):
    file.write_text("".join(" ".join(f"{v:.9f}" for v in row) + "\n" for row in rows))


@jit_quickly
def followed(camera, mount, log):
    state = SofSlam(DEFAULT, camera, mount).init(jax.random.key(0), CAPACITY)
    return SofSlam(DEFAULT, camera, mount).run(state, log)[1].T_world_robot


def errors_of(drive, log, kept=slice(None)):
    """Of the estimate from the odometry as it is read: metres and degrees."""
    steps, sigma = motions(drive), motion_sigmas(drive)
    sigma = np.zeros((len(steps), 3)) if sigma is None else sigma
    log = dataclasses.replace(
        jax.tree.map(lambda a: a[kept], log),
        motion=SE2(jnp.asarray(steps[:, :2], float), jnp.asarray(steps[:, 2], float)),
        motion_sigma=jnp.asarray(sigma, float),
    )
    T = followed(drive.camera_file.camera, drive.camera_file.mount, log)
    estimate = Trajectory(drive.image_stamps, np.asarray(T.xy, float), np.unwrap(T.yaw))
    errors, _ = evaluate_trajectory(drive.groundtruth, estimate)
    return errors.ate_m, errors.yaw_deg


def jump(rows):
    yaw = 2 * np.arctan2(rows[75, 6], rows[75, 7])
    rows[75:, 1:3] += 1.5 * np.array([np.cos(yaw), np.sin(yaw)])
    return rows


def restart(rows):
    T = SE2(jnp.asarray(rows[:, 1:3]), jnp.asarray(2 * np.arctan2(rows[:, 6], rows[:, 7])))
    again = jax.tree.map(lambda a: a[75:], T)
    again = jax.tree.map(lambda a: a[75], T).between(again)
    rows[75:, 1:3] = again.xy
    rows[75:, 6], rows[75:, 7] = np.sin(again.yaw / 2), np.cos(again.yaw / 2)
    return rows


def stall(rows):
    rows[75:100, 1:] = rows[75, 1:]
    return rows


def hole(rows):
    return rows[(rows[:, 0] <= 1.0) | (rows[:, 0] >= 5.0)]


def cut(rows):
    return rows[rows[:, 0] <= 4.0]


def late(rows):
    return rows[rows[:, 0] >= 2.0]


FAULTS = {
    "nothing": (lambda rows: rows, None),
    "a jump by 1.5 m": (jump, "line 76: a step of 1.5"),
    "a restart": (restart, "line 76: the odometry restarts at the origin"),
    "a stall of a second": (stall, "line 101: the pose stands still for 1.00 s"),
    "a hole of four seconds": (hole, "line 27: no row for 4.00 s from 1.00 s on"),
    "an end before that of the images": (cut, "no row after 4.00 s"),
    "a beginning behind that of the images": (late, "no row before 2.00 s"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_an_odometry_that_is_spoilt_is_told_and_survived(drive, log, fault):
    change, sentence = FAULTS[fault]
    write(drive / "odometry.txt", change(table(drive / "odometry.txt")))
    read = read_drive(drive)
    told = odometry_warnings(read)
    assert (sentence is None and told == []) or (len(told) == 1 and sentence in told[0])
    metres, degrees = errors_of(read, log)
    unread = change in (cut, late)  # for two seconds, and nothing behind or before it
    assert metres < (0.05 if unread else 0.02) and degrees < (1.0 if unread else 0.3)


def test_a_hole_in_the_images_is_no_error_of_the_estimate(drive, log):
    rows = (drive / "rgb.txt").read_text().splitlines()
    stamps = np.array([float(row.split()[0]) for row in rows])
    kept = (stamps <= 1.0) | (stamps >= 5.0)
    (drive / "rgb.txt").write_text("\n".join(np.array(rows)[kept]))
    metres, degrees = errors_of(read_drive(drive), log, kept)
    assert metres < 0.03 and degrees < 0.3


def test_a_run_tells_what_it_found(drive, tmp_path, capfd):
    """Repeated images, another size, a jump, rows twice and stamps in nanoseconds at once."""
    write(drive / "odometry.txt", jump(table(drive / "odometry.txt")))
    for name in ("rgb.txt", "odometry.txt", "groundtruth.txt"):
        rows = [row.split(maxsplit=1) for row in (drive / name).read_text().splitlines()]
        rows = [f"{round(float(stamp) * 1e9)} {rest}" for stamp, rest in rows]
        (drive / name).write_text("\n".join(rows + rows[-1:]))
    for i in range(25, 31):
        shutil.copy(drive / "rgb" / "000024.jpg", drive / "rgb" / f"{i:06d}.jpg")
    cv2.imwrite(str(drive / "rgb" / "000000.jpg"), np.zeros((480, 640), np.uint8))
    out = tmp_path / "out"
    args = ["--particles", "50", "--loop", "none", "--out", str(out)]
    assert main(["run", str(drive), *args]) == 0
    told = capfd.readouterr().out
    for words in (
        "the timestamps are nanoseconds",
        "odometry.txt: 1 rows repeat another and were dropped",
        "line 76: a step of 1.5",
        "7 of 60 images could not be used",
        "6 repeat the image before while the robot moves",
        "1 have another size than the camera's",
    ):
        assert words in told
    assert main(["inspect", str(drive), "--out", str(tmp_path / "a.png")]) == 0
    inspected = capfd.readouterr().out
    assert "6 repeat the image before while the robot moves, 000025.jpg first" in inspected
    assert "line 76: a step of 1.5" in inspected and "verdict   usable" in inspected


def test_inspect_calls_a_wrong_set_up_doubtful(drive, tmp_path, capfd):
    rows = table(drive / "odometry.txt")
    write(drive / "odometry.txt", rows[:, [0, 2, 1, *range(3, 8)]])
    assert main(["inspect", str(drive), "--out", str(tmp_path / "a.png")]) == 3
    told = capfd.readouterr().out
    assert (
        "Likely cause: x and y of the odometry are swapped" in told and "verdict   doubtful" in told
    )
