"""`sofjax calibrate mount` and `run --calibrate`, on the sample, and what they refuse."""

import json
import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from sofjax.calibration import UNKNOWNS
from sofjax.cli import main
from sofjax.cli.calibrate_robot import free_names
from sofjax.geometry import Mount
from sofjax.io.camera_file import read_camera
from sofjax.pipeline.outcomes import FREE
from sofjax.vision import rectify

OFFICE = Path(__file__).parent.parent / "examples" / "office"
TILT = math.radians(15)


def test_what_may_be_freed_is_what_the_fit_knows():
    assert FREE == UNKNOWNS


def make_drive(folder, images):
    """The first images of the sample; the other files are whole."""
    (folder / "rgb").mkdir(parents=True)
    for name in ("camera.yaml", "odometry.txt", "groundtruth.txt", "floor_segments.csv"):
        shutil.copy(OFFICE / name, folder / name)
    for i in range(images):
        shutil.copy(OFFICE / "rgb" / f"{i:06d}.jpg", folder / "rgb")
    lines = (OFFICE / "rgb.txt").read_text().splitlines()
    (folder / "rgb.txt").write_text("\n".join(lines[: images + 1]) + "\n")
    return folder


def calibrate(*args):
    return main(["calibrate", "mount", *map(str, args)])


@pytest.fixture
def refused(capfd):
    """What is said of bad input: one sentence on stderr, exit code 2."""

    def call(*args):
        assert calibrate(*args) == 2
        err = capfd.readouterr().err
        assert err.startswith("sofjax: ") and "Traceback" not in err
        return err

    return call


@pytest.mark.slow
def test_the_sample_s_mount_is_found_from_far_off(tmp_path, capfd):
    out = tmp_path / "camera.yaml"
    assert calibrate(OFFICE, "--initial", "height=0.78,pitch=0.4", "-o", out) == 0
    mount = read_camera(out).mount  # the odometer reads 0.99 of the distance
    assert float(mount.height) == pytest.approx(0.594, rel=0.015)
    assert float(mount.pitch) == pytest.approx(TILT, abs=math.radians(0.2))
    assert abs(float(mount.roll)) < math.radians(0.1)  # its right turns read 7 % too much
    assert float(mount.x) == pytest.approx(0.05) and float(mount.yaw) == 0
    said = capfd.readouterr().out
    for word in (
        "± ",
        "correlation",
        "px, root mean square",
        "5 of 5",
        "odometer",
        "verdict   good",
    ):
        assert word in said
    image = cv2.imread(str(out.with_suffix(".png")))
    assert min(image.shape[:2]) > 300 and image.std() > 5


@pytest.mark.slow
def test_a_run_calibrates_first_and_tells_both(tmp_path, capfd):
    drive = make_drive(tmp_path / "drive", 120)
    text = (drive / "camera.yaml").read_text()
    (drive / "camera.yaml").write_text(text.replace("height: 0.6,", "height: 0.66,"))
    out = tmp_path / "run"
    assert main(["run", str(drive), "--calibrate", "--particles", "50", "--out", str(out)]) == 0
    report = json.loads((out / "report.json").read_text())
    told = report["calibration"]
    assert told["usable"] and told["before"]["height"] == pytest.approx(0.66)
    assert told["after"]["height"] == pytest.approx(0.594, rel=0.03)
    written = float(read_camera(out / "camera.yaml").mount.height)
    assert written == pytest.approx(told["after"]["height"], rel=1e-6)
    assert report["errors"]["trajectory"]["ate_m"] < 0.1
    said = capfd.readouterr().out
    assert "verdict   good" in said and "frames a second" in said


@pytest.mark.slow
def test_a_drive_that_tells_nothing_is_no_answer(tmp_path, capfd):
    drive = make_drive(tmp_path / "drive", 12)
    out = tmp_path / "camera.yaml"
    assert calibrate(drive, "-o", out) == 3
    said = capfd.readouterr().out
    assert "not usable" in said and "too few lines" in said and "is not written" in said
    assert not out.exists()
    run = tmp_path / "run"
    assert main(["run", str(drive), "--calibrate", "--out", str(run)]) == 3
    assert "is not run" in capfd.readouterr().out


@pytest.mark.slow
def test_poses_lines_and_mount_together(tmp_path, capfd):
    drive, out = make_drive(tmp_path / "drive", 100), tmp_path / "camera.yaml"
    assert calibrate(drive, "--joint", "-o", out) == 0
    mount = read_camera(out).mount
    assert float(mount.height) == pytest.approx(0.594, rel=0.03)
    assert float(mount.pitch) == pytest.approx(TILT, abs=math.radians(0.3))
    assert "jointly" in capfd.readouterr().out


def test_names_to_free():
    assert free_names(" pitch , height,pitch") == ("pitch", "height")


def test_bad_options(refused, tmp_path):
    out = ("-o", tmp_path / "camera.yaml")
    assert "there is no 'tilt'" in refused(OFFICE, "--free", "height,tilt", *out)
    assert "at least must be free" in refused(OFFICE, "--free", "left", *out)
    assert "leave 'distance' out" in refused(OFFICE, "--free", "pitch,distance", "--joint", *out)
    assert "greater than 0" in refused(OFFICE, "--initial", "height=-1", *out)
    assert "no field 'hight'" in refused(OFFICE, "--initial", "hight=1", *out)
    assert "above the horizon" in refused(OFFICE, "--initial", "pitch=-1.2", *out)
    assert "is a folder" in refused(OFFICE, "-o", tmp_path)
    (tmp_path / "file").write_text("")
    assert "cannot be written" in refused(OFFICE, "-o", tmp_path / "file" / "camera.yaml")


def test_a_drive_that_is_none(refused, tmp_path):
    assert "no such drive" in refused(tmp_path / "nothing")


def test_a_robot_that_stands_still(refused, tmp_path):
    drive = make_drive(tmp_path / "drive", 5)
    stamps = [line.split()[0] for line in (drive / "odometry.txt").read_text().splitlines()[1:]]
    rows = [f"{stamp} 0 0 0 0 0 0 1\n" for stamp in stamps if stamp[0] != "#"]
    (drive / "odometry.txt").write_text("".join(rows))
    assert "moves by 0.000 m" in refused(drive, "-o", tmp_path / "camera.yaml")


def test_the_floor_from_above_has_its_lines_where_they_are(camera):
    """A tile's edge 2 m ahead, drawn into the image through the mount, lies at 2 m."""
    mount = Mount.create(height=0.6, pitch=0.3)
    v = 119.5 + 270 * math.tan(math.atan2(0.6, 2.0) - 0.3)  # the row that sees x = 2 m
    image = np.where(np.arange(240)[:, None] > v, 200, 50).astype(np.uint8) * np.ones(
        (1, 320), np.uint8
    )
    above = rectify(image, camera, mount, np.zeros(3), (1.5, 3.0, -0.3, 0.3), pixels=300)
    edge = lambda picture: 3.0 - np.flatnonzero(picture[:, 60] > 125)[0] * 1.5 / 300
    assert edge(above) == pytest.approx(2.0, abs=0.03)
    assert above.shape == (300, 120)
    # from half a metre further on the same edge is half a metre further on
    moved = rectify(image, camera, mount, np.array([0.5, 0, 0]), (1.5, 3.0, -0.3, 0.3), pixels=300)
    assert edge(moved) == pytest.approx(2.5, abs=0.03)
