"""What a drive betrays about its set-up is told, with the mistake that explains it."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sofjax.geometry import SE2
from sofjax.io.drive import motions, read_drive
from sofjax.io.trajectory import Trajectory
from sofjax.motion import MotionModel
from sofjax.pipeline import setup_checks
from sofjax.slam.presets import DEFAULT
from sofjax.vision import Frontend, observe_drive

OFFICE = Path(__file__).parent.parent / "examples" / "office"
IMAGES = 40


@pytest.fixture(scope="module")
def seen():
    """The first images of the sample, from the third second on, and what they show."""
    drive = read_drive(OFFICE)
    part = slice(30, 30 + IMAGES)
    files, stamps = drive.image_files[part], drive.image_stamps[part]
    drive = dataclasses.replace(drive, image_files=files, image_stamps=stamps)
    return drive, observe_drive(drive, Frontend(drive.camera_file))


def spoilt(seen, odometry=None, mount=None):
    """The drive by another odometry or mount, with what it then reads of the motions."""
    drive, log = seen
    file = dataclasses.replace(drive.camera_file, mount=mount or drive.camera_file.mount)
    drive = dataclasses.replace(drive, odometry=odometry or drive.odometry, camera_file=file)
    steps = motions(drive)
    motion = SE2(jnp.asarray(steps[:, :2], float), jnp.asarray(steps[:, 2], float))
    return setup_checks.set_up(DEFAULT, drive, dataclasses.replace(log, motion=motion))


def test_a_set_up_that_is_right_is_not_doubted(seen):
    assert spoilt(seen) == []


MISTAKES = {
    "the odometry reads half of the way": lambda xy, yaw: (0.5 * xy, yaw),
    "the odometry is in millimetres": lambda xy, yaw: (1000 * xy, yaw),
    "x and y of the odometry are swapped": lambda xy, yaw: (xy[:, ::-1], yaw),
    "the odometry's x and y have the wrong sign": lambda xy, yaw: (-xy, yaw),
}


@pytest.mark.parametrize("words", MISTAKES)
def test_a_mistake_of_the_odometry_is_named(seen, words):
    odometry = seen[0].odometry
    changed = Trajectory(odometry.stamps, *MISTAKES[words](odometry.xy, odometry.yaw))
    (doubt,) = spoilt(seen, odometry=changed)
    assert f"Likely cause: {words}" in doubt


@pytest.mark.parametrize("roll", [np.pi / 2, np.pi, -np.pi / 2])
def test_a_camera_that_is_turned_is_named(seen, roll):
    mount = seen[0].camera_file.mount
    (doubt,) = spoilt(seen, mount=dataclasses.replace(mount, roll=jnp.asarray(roll, float)))
    assert "Likely cause: the mount's roll, 0.00 rather than" in doubt


def test_what_none_of_the_usual_mistakes_explains_is_told_by_its_share(seen):
    odometry = seen[0].odometry
    changed = Trajectory(odometry.stamps, odometry.xy, 57.3 * odometry.yaw)
    (doubt,) = spoilt(seen, odometry=changed)
    assert doubt.startswith("only ") and "Likely causes, the likeliest first" in doubt


def test_too_few_segments_tell_nothing(seen):
    drive, log = seen
    few = jax.tree.map(lambda a: a[:2], log)
    assert setup_checks.set_up(DEFAULT, drive, few) == []


def test_an_odometer_that_errs_as_none_does_is_told():
    model = MotionModel(distance_scale_sigma=0.01, turn_scale_sigma=0.05, curvature_sigma=0.0)
    usual = {"distance": 0.03, "left": -0.2, "right": 0.2, "curvature": 9.0}
    assert setup_checks.odometer(usual, model) == []
    (doubt,) = setup_checks.odometer(usual | {"distance": 0.06}, model)
    assert "error in distances was learned as +6.0%, 6 standard deviations" in doubt
    (doubt,) = setup_checks.odometer(usual | {"right": -0.3}, model)
    assert "turns to the right was learned as -30.0%" in doubt


def test_a_height_that_no_tape_gives_is_told():
    assert setup_checks.fitted_height(0.6, 0.5) == setup_checks.fitted_height(0.6, 0.8) == []
    (doubt,) = setup_checks.fitted_height(0.2904, 0.6)
    assert "0.48 of the 0.6 m" in doubt and "does the odometer read half of the way" in doubt
    (doubt,) = setup_checks.fitted_height(1.2, 0.6)
    assert "read double of the way" in doubt


def test_holes_in_the_images_are_told_once_each_and_not_without_end():
    assert setup_checks.holes(0.1 * np.arange(50)) == []
    assert setup_checks.holes(np.append(0.1 * np.arange(50), 8.9)) == [
        "no image for 4.00 s from 4.90 s on"
    ]
    many = np.concatenate([0.1 * np.arange(10) + 5 * i for i in range(20)])
    told = setup_checks.holes(many)
    assert len(told) == 6 and told[-1].startswith("14 more times")
