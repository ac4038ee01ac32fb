"""The commands, end to end on the first images of the sample."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from sofjax import viewer
from sofjax.cli import main
from sofjax.cli.arguments import make_parser
from sofjax.cli.run import settings_of
from sofjax.io.drive import motions, read_drive
from sofjax.io.map_file import read_map
from sofjax.io.trajectory import read_trajectory

OFFICE = Path(__file__).parent.parent / "examples" / "office"
IMAGES = 40
SMALL = ["--particles", "50", "--loop", "none"]  # the smoothing takes its time to compile
FILES = {"trajectory.txt", "map.geojson", "map.png", "report.json", "config.toml", ".sofjax-run"}


def make_drive(drive, images=IMAGES):
    (drive / "rgb").mkdir(parents=True)
    for name in ("camera.yaml", "odometry.txt", "groundtruth.txt", "floor_segments.csv"):
        shutil.copy(OFFICE / name, drive / name)
    for i in range(images):
        shutil.copy(OFFICE / "rgb" / f"{i:06d}.jpg", drive / "rgb")
    lines = (OFFICE / "rgb.txt").read_text().splitlines()
    (drive / "rgb.txt").write_text("\n".join(lines[: images + 1]) + "\n")
    return drive


def run(*args):
    return main([str(arg) for arg in ("run", *args, *SMALL)])


def report_of(folder):
    return json.loads((folder / "report.json").read_text())


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return make_drive(tmp_path_factory.mktemp("drives") / "short")


@pytest.fixture(scope="module")
def done(drive, tmp_path_factory):
    """A run of the drive that the tests look at."""
    folder = tmp_path_factory.mktemp("runs") / "done"
    assert main(["run", str(drive), "--out", str(folder), *SMALL[:2]]) == 0
    return folder


def test_a_run_writes_its_six_files_a_marker_and_no_more(done):
    assert {path.name for path in done.iterdir()} == FILES | {"trajectory_smoothed.txt"}


def test_the_smoothed_trajectory_is_another_and_no_worse(done):
    online, smoothed = (
        read_trajectory(done / name) for name in ("trajectory.txt", "trajectory_smoothed.txt")
    )
    np.testing.assert_allclose(smoothed.stamps, online.stamps)
    assert 0 < np.abs(smoothed.xy - online.xy).max() < 0.2
    report = report_of(done)
    assert report["errors"]["smoothed"]["ate_m"] < report["errors"]["trajectory"]["ate_m"] + 0.005
    loop = report["loop"]
    assert loop["asked"] == "smooth" and loop["keyframes"] > 10 and loop["lines"] > 5
    assert all(cost["after"] <= cost["before"] for cost in loop["cost"])


def test_without_closing_only_the_online_estimate_is_written(drive, tmp_path):
    assert run(drive, "--out", tmp_path) == 0
    assert {path.name for path in tmp_path.iterdir()} == FILES
    report = report_of(tmp_path)
    assert report["loop"] == {"asked": "none"} and report["errors"]["smoothed"] is None


def test_the_trajectory_has_a_row_for_every_image(done, drive):
    read = read_trajectory(done / "trajectory.txt")
    np.testing.assert_allclose(read.stamps, read_drive(drive).image_stamps)
    np.testing.assert_allclose(read.xy[0], 0, atol=0.01)


def test_the_map_has_segments_and_how_often_each_was_seen(done):
    segments, seen = read_map(done / "map.geojson")
    assert len(segments) > 5
    assert (seen > 0).all()
    assert np.isfinite(segments).all()


def test_the_figure_is_a_picture(done):
    image = cv2.imread(str(done / "map.png"))
    assert min(image.shape[:2]) > 300
    assert image.std() > 5


def test_the_report_counts_the_funnel_and_the_errors(done):
    report = report_of(done)
    funnel = report["funnel"]
    assert funnel["images"] == IMAGES
    assert funnel["segments"] >= funnel["below_horizon"] >= funnel["associated"] > 0
    assert funnel["below_horizon"] >= funnel["matched"] > 0
    assert funnel["mapped"] == len(read_map(done / "map.geojson")[0])
    assert report["frames_per_second"] > 0
    stages = {"decode", "undistort", "detect", "wait", "step"}
    assert set(report["milliseconds_per_image"]) == stages
    assert report["seed"] == 0 and report["settings"]["filter.particles"] == 50
    assert "jax" in report["versions"] and report["peak_memory_mib"] > 50
    assert report["errors"]["trajectory"]["ate_m"] < 0.1
    assert report["errors"]["odometry"]["ate_m"] > 0
    assert 0 <= report["errors"]["map"]["precision"] <= 1
    assert report["images"]["unreadable"] == [] and not report["interrupted"]


def test_the_config_of_a_run_gives_the_same_files_again(done, drive, tmp_path):
    args = ["run", str(drive), "--out", str(tmp_path), "--config", str(done / "config.toml")]
    assert main(args) == 0
    for name in sorted(FILES - {"report.json", ".sofjax-run"} | {"trajectory_smoothed.txt"}):
        assert (tmp_path / name).read_bytes() == (done / name).read_bytes(), name


def test_another_seed_gives_another_trajectory(done, drive, tmp_path):
    assert run(drive, "--out", tmp_path, "--seed", 3) == 0
    name = "trajectory.txt"
    assert (tmp_path / name).read_bytes() != (done / name).read_bytes()
    assert report_of(tmp_path)["seed"] == 3


def test_settings_come_from_the_preset_the_file_and_the_options_in_this_order(drive, tmp_path):
    def gathered(*args):
        return settings_of(make_parser().parse_args(["run", str(drive), *map(str, args)]))

    assert gathered().frontend.detector == "lsd" and gathered().loop == "smooth"
    assert gathered("--set", "preset=paper").loop == "none"
    assert gathered("--set", "preset=paper", "--loop", "smooth").loop == "smooth"
    assert gathered("--set", "preset=paper").frontend.detector == "hough"
    recall = lambda *args: gathered(*args).used.slam.segment_map.recall
    assert recall("--loop", "paper") == 150 < recall("--loop", "none")
    assert recall("--loop", "paper", "--set", "segment_map.recall=99") == 99
    file = tmp_path / "c.toml"
    file.write_text('preset = "paper"\nseed = 4\n[frontend]\ncapacity = 9\n')
    from_file = gathered("--config", file)
    assert (from_file.seed, from_file.frontend.capacity) == (4, 9)
    assert from_file.frontend.detector == "hough"
    changed = gathered("--config", file, "--set", "frontend.capacity=5", "seed=6", "--seed", 7)
    assert (changed.seed, changed.frontend.capacity) == (7, 5)
    assert gathered("--config", file, "--set", "preset=default").frontend.capacity == 64


def test_the_drive_may_stand_behind_set(drive, tmp_path):
    args = ["run", "--out", str(tmp_path), *SMALL, "--set", "seed=3", str(drive)]
    assert main(args) == 0
    assert report_of(tmp_path)["seed"] == 3


def test_results_go_to_a_folder_of_their_own_by_default(drive, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(drive) == 0
    assert run(drive) == 0
    folders = list((tmp_path / "runs").iterdir())
    assert len(folders) == 2
    assert all(folder.name.startswith("short-") for folder in folders)


def test_what_an_earlier_run_left_is_not_mixed_with_the_new(drive, tmp_path, monkeypatch):
    monkeypatch.setattr(viewer, "available", lambda: False)
    (tmp_path / "notes.txt").write_text("mine")
    assert run(drive, "--out", tmp_path) == 0
    # a figure of the first run, as with matplotlib it would have drawn
    with open(tmp_path / ".sofjax-run", "a") as marker:
        marker.write("map.png\n")
    (tmp_path / "map.png").write_text("old")
    assert run(drive, "--out", tmp_path) == 0
    assert {p.name for p in tmp_path.iterdir()} == FILES - {"map.png"} | {"notes.txt"}


def test_without_matplotlib_all_but_the_figure_is_written(drive, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(viewer, "available", lambda: False)
    assert run(drive, "--out", tmp_path) == 0
    assert {path.name for path in tmp_path.iterdir()} == FILES - {"map.png"}
    assert "pip install 'sofjax[figures]'" in capfd.readouterr().out
    assert main(["inspect", str(drive), "--out", str(tmp_path / "a.png")]) == 0
    assert "pip install 'sofjax[figures]'" in capfd.readouterr().err


def test_a_drive_without_truth_has_no_errors(tmp_path, capfd):
    drive = make_drive(tmp_path / "drive")
    (drive / "groundtruth.txt").unlink()
    (drive / "floor_segments.csv").unlink()
    assert run(drive, "--out", tmp_path / "out") == 0
    assert report_of(tmp_path / "out")["errors"] == {
        "trajectory": None, "smoothed": None, "odometry": None, "map": None
    }  # fmt: skip
    assert "against the truth" not in capfd.readouterr().out
    assert (tmp_path / "out" / "map.png").exists()


def test_a_truth_of_another_time_is_a_warning(tmp_path, capfd):
    drive = make_drive(tmp_path / "drive")
    (drive / "groundtruth.txt").write_text("900 0 0 0 0 0 0 1\n901 0 0 0 0 0 0 1\n")
    assert run(drive, "--out", tmp_path / "out") == 0
    assert any("must share" in warning for warning in report_of(tmp_path / "out")["warnings"])


def test_unreadable_images_are_skipped_counted_and_named(tmp_path, capfd):
    drive = make_drive(tmp_path / "drive")
    (drive / "rgb" / "000007.jpg").unlink()
    (drive / "rgb" / "000008.jpg").write_bytes(b"no image")
    cv2.imwrite(str(drive / "rgb" / "000009.jpg"), np.zeros((480, 640), np.uint8))
    assert run(drive, "--out", tmp_path / "out") == 0
    report = report_of(tmp_path / "out")
    names = ["rgb/000007.jpg", "rgb/000008.jpg", "rgb/000009.jpg"]
    assert report["images"]["unreadable"] == names
    assert any(warning.startswith("3 of 40 images") for warning in report["warnings"])
    assert "rgb/000007.jpg" in capfd.readouterr().out
    assert len(read_trajectory(tmp_path / "out" / "trajectory.txt").stamps) == IMAGES


def test_without_one_segment_the_pose_follows_the_odometry(tmp_path):
    drive = make_drive(tmp_path / "drive")
    for file in (drive / "rgb").iterdir():
        cv2.imwrite(str(file), np.zeros((240, 320), np.uint8))
    assert run(drive, "--out", tmp_path / "out") == 0
    assert len(read_map(tmp_path / "out" / "map.geojson")[0]) == 0
    way = np.hypot(*motions(read_drive(drive))[:, :2].T).sum()
    estimate = read_trajectory(tmp_path / "out" / "trajectory.txt")
    assert np.hypot(*estimate.xy[-1]) == pytest.approx(way, abs=0.1)
    warnings = report_of(tmp_path / "out")["warnings"]
    assert any("no segment at all" in warning for warning in warnings)


def test_a_drive_of_one_image(tmp_path):
    drive = make_drive(tmp_path / "drive", images=1)
    assert run(drive, "--out", tmp_path / "out") == 0
    assert report_of(tmp_path / "out")["frames_per_second"] is None
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES
