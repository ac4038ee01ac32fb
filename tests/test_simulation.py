"""Simulated drives as folders, and what the simulator refuses."""

import itertools
import re

import numpy as np
import pytest
from simulated import office_camera, run_of, world_of

from sofjax.cli import main
from sofjax.io.drive import motions, read_drive
from sofjax.simulation import (
    RobotSetup,
    random_setup,
    record,
    simulate_run,
)
from sofjax.simulation.robot import increments


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("drives") / "short"
    setup = RobotSetup(camera_file=office_camera())
    simulated = simulate_run(world_of("l", 2), setup, 2, max_images=12)
    record(path, world_of("l", 2), setup, simulated, seed=2)
    return path, simulated


def test_a_recorded_drive_reads_back(recorded):
    path, simulated = recorded
    drive = read_drive(path)
    assert len(drive.image_files) == 12 and all(file.exists() for file in drive.image_files)
    np.testing.assert_allclose(drive.groundtruth.xy, simulated.truth.xy, atol=1e-6)
    np.testing.assert_allclose(drive.camera_file.distortion, office_camera().distortion)
    expected = world_of("l", 2).floor_segments.endpoints[:, :, :2]
    np.testing.assert_allclose(drive.floor_segments, expected, atol=5.1e-5)
    assert not [file for file in path.parent.iterdir() if file.name.startswith(".")]


def test_the_written_odometry_gives_the_motions_that_observe_takes(recorded):
    path, simulated = recorded
    written, given = motions(read_drive(path)), simulated.motions()
    np.testing.assert_allclose(written[:, :2], given.xy, atol=1e-4)
    np.testing.assert_allclose(written[:, 2], given.yaw, atol=1e-4)


def test_simulate_writes_a_drive(tmp_path, capsys):
    out = tmp_path / "drive"
    args = ["--world", "random", "--seed", "3", "--images", "4", "--height", "0.8", "--pitch", "15"]
    assert main(["simulate", *args, "--out", str(out)]) == 0
    mount = read_drive(out).camera_file.mount
    assert float(mount.height) == pytest.approx(0.8)
    assert float(mount.pitch) == pytest.approx(np.radians(15), rel=1e-5)
    assert "4 images" in capsys.readouterr().out


def test_random_setups_differ():
    heights = {round(float(random_setup(seed).camera_file.mount.height), 3) for seed in range(5)}
    assert len(heights) == 5


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--world", "papr"], "did you mean 'paper'"),
        (["--world", "l", "--way", "0,0 0,9 20,9"], "goes through a wall at (9.0"),
        (["--way", "0,1 0,1.01"], "within 0.1 m"),
        (["--way", "0,1 x"], "must be numbers"),
        (["--way", "0.9,1 0.9,9"], "of a wall"),
        (["--height", "5"], "above the ceiling"),
        (["--height", "0"], "under the floor"),
        (["--pitch", "-80"], "sees no floor"),
        (["--x", "3"], "camera goes through a wall"),
        (["--x", "nan"], "no place for a camera"),
        (["--noise", "-1"], "noise is -1"),
        (["--blur", "inf"], "blur is inf"),
        (["--vibration", "-1"], "vibration"),
        (["--dropped", "1"], "dropped"),
        (["--speed", "0"], "speed"),
        (["--odometer", "slip=-1"], "slips per metre is -1"),
        (["--odometer", "rigth=1"], "did you mean 'right'"),
        (["--odometer", "right=one"], "must be numbers"),
        (["--size", "big"], "like 640x480"),
        (["--focal", "1"], "--focal"),
        (["--distortion", "1", "2"], "--distortion"),
        (["--world", "l", "--distortion", "-0.9", "0", "0", "0"], "folds the image"),
        (["--images", "1"], "2 at least"),
        (["--seed", "-1"], "--seed"),
    ],
)
def test_what_cannot_be_simulated_gets_a_sentence(arguments, sentence, tmp_path, capsys):
    out = tmp_path / "drive"
    assert main(["simulate", *arguments, "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert sentence in said and said.startswith("sofjax: ") and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_folder_with_something_in_it_is_left_alone(tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("mine")
    assert main(["simulate", "--world", "l", "--images", "3", "--out", str(tmp_path)]) == 2
    assert "there already" in capsys.readouterr().err
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_increments_of_a_path_begin_with_none():
    steps = increments(run_of("l").truth)
    assert float(steps.xy[0, 0]) == 0 and float(steps.yaw[0]) == 0
    pairs = itertools.islice(zip(run_of("l").truth.yaw[1:], run_of("l").truth.yaw, strict=False), 5)
    np.testing.assert_allclose([a - b for a, b in pairs], steps.yaw[1:6], atol=1e-6)


@pytest.mark.slow
def test_the_demo_ends_with_a_page(tmp_path, capsys):
    folder = tmp_path / "demo"
    assert main(["demo", "--world", "l", "--out", str(folder)]) == 0
    page = (folder / "index.html").read_text()
    for source in re.findall(r'src="([^"]+)"', page):
        assert (folder / source).stat().st_size > 1000
    assert "odometer alone" in page and "[3/3]" in capsys.readouterr().out


def test_the_demo_refuses_an_unknown_world(tmp_path, capsys):
    assert main(["demo", "--world", "maze", "--out", str(tmp_path / "demo")]) == 2
    assert "there is no world 'maze'" in capsys.readouterr().err
