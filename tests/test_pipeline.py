"""The pipeline as a library: what the commands print is there, and nothing is printed."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from test_cli import make_drive

from sofjax.cli import main
from sofjax.io.drive import read_drive
from sofjax.io.errors import InputError
from sofjax.io.map_file import read_map
from sofjax.io.settings import with_settings
from sofjax.io.trajectory import Trajectory, read_trajectory
from sofjax.pipeline import (
    RunSettings,
    calibrate_drive,
    evaluate_run,
    inspect_drive,
    online,
    open_run,
    run_drive,
)
from sofjax.pipeline.outcomes import DriveVerdict, LoopStatus
from sofjax.pipeline.progress import watched
from sofjax.vision import DETECTORS, detect_lsd

IMAGES = 40
SMALL = with_settings(RunSettings(loop="none"), {"filter.particles": 50}, "here")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return read_drive(make_drive(tmp_path_factory.mktemp("drives") / "short", IMAGES))


@pytest.fixture(scope="module")
def result(drive):
    return run_drive(drive, SMALL)


def first(drive, images):
    """A drive's first images."""
    return dataclasses.replace(
        drive, image_files=drive.image_files[:images], image_stamps=drive.image_stamps[:images]
    )


def test_a_drive_gives_its_path_its_map_and_its_errors(drive, result):
    np.testing.assert_allclose(result.trajectory.stamps, drive.image_stamps)
    assert result.trajectory.xy.shape == (IMAGES, 2)
    assert len(result.segments) == len(result.map.measurements) == len(result.map.height) > 5
    assert result.errors.trajectory.ate_m < 0.1 and result.errors.map.precision > 0.5
    assert result.closed is None and result.errors.smoothed is None
    assert result.loop == {"asked": "none"} and not result.stopped
    assert set(result.seconds) == {"start", "drive", "write"}
    assert int(result.state.segment_map.valid.sum()) == len(result.segments) + result.map.left_out


def test_the_library_writes_and_prints_nothing(drive, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    calls = []
    run_drive(first(drive, 5), SMALL, progress=lambda done, of: calls.append((done, of)))
    assert calls == [(i, 5) for i in range(1, 6)]
    assert capfd.readouterr() == ("", "") and not list(tmp_path.iterdir())


def test_with_a_writer_the_files_are_those_of_the_command(drive, result, tmp_path):
    with open_run(tmp_path / "library", drive, SMALL) as writer:
        again = run_drive(drive, SMALL, writer=writer)
    command = ["run", drive.path, "--out", tmp_path / "command", "--particles", 50]
    assert main([str(word) for word in [*command, "--loop", "none"]]) == 0
    for name in ("trajectory.txt", "map.geojson", "config.toml", "map.png"):
        library, of_command = (tmp_path / where / name for where in ("library", "command"))
        assert library.read_bytes() == of_command.read_bytes(), name
    written = read_trajectory(tmp_path / "library" / "trajectory.txt")
    np.testing.assert_allclose(written.xy, again.trajectory.xy, atol=1e-6)
    np.testing.assert_array_equal(again.trajectory.xy, result.trajectory.xy)
    np.testing.assert_allclose(read_map(tmp_path / "library" / "map.geojson")[0], again.segments,
                               atol=1e-4)  # fmt: skip
    evaluation = evaluate_run(tmp_path / "library")
    assert evaluation.trajectory.ate_m == pytest.approx(again.errors.trajectory.ate_m, rel=1e-3)
    assert evaluation.map.precision == pytest.approx(again.errors.map.precision, abs=0.01)
    report = json.loads((tmp_path / "library" / "report.json").read_text())
    assert report["errors"]["trajectory"]["ate_m"] == again.errors.trajectory.ate_m


def test_an_interrupted_drive_gives_what_was_done_until_then(drive, monkeypatch):
    views = online.views

    def interrupted(frontend, files):
        for i, view in enumerate(views(frontend, files)):
            if i == 3:
                raise KeyboardInterrupt
            yield view

    monkeypatch.setattr(online, "views", interrupted)
    settings = dataclasses.replace(SMALL, loop="smooth")
    result = run_drive(drive, settings)
    assert len(result.trajectory.stamps) == 3 and result.interrupted and result.stopped
    assert result.loop == {"asked": "smooth", "status": LoopStatus.INTERRUPTED}


def test_a_detector_of_ones_own_runs(drive, monkeypatch):
    """By its name, for the library and the command alike."""
    monkeypatch.setitem(DETECTORS, "mine", lambda image: detect_lsd(image)[:7])
    settings = with_settings(SMALL, {"frontend.detector": "mine"}, "here")
    assert run_drive(first(drive, 4), settings).log.detected <= 4 * 7


def test_a_seed_draws_other_numbers(drive, result):
    other = run_drive(drive, dataclasses.replace(SMALL, seed=1))
    assert (other.trajectory.xy != result.trajectory.xy).any()


def test_a_drive_is_inspected_and_judged(drive):
    found = inspect_drive(first(drive, 10))
    assert found.verdict == DriveVerdict.GOOD and not found.warnings
    assert found.seen.segments > found.seen.below_horizon > found.seen.associated > 0
    wrong = dataclasses.replace(drive, contradictions=["the clock runs back"])
    judged = inspect_drive(first(wrong, 3))
    assert judged.verdict == DriveVerdict.DOUBTFUL and judged.warnings == ["the clock runs back"]


def test_what_cannot_be_calibrated_is_refused(drive):
    still = Trajectory(drive.odometry.stamps, 0 * drive.odometry.xy, 0 * drive.odometry.yaw)
    with pytest.raises(InputError, match=r"moves by 0\.000 m"):
        calibrate_drive(dataclasses.replace(drive, odometry=still))
    with pytest.raises(ValueError, match="no 'tilt' to fit"):
        calibrate_drive(drive, free=("tilt",))
    with pytest.raises(ValueError, match="at least must be free"):
        calibrate_drive(drive, free=("left",))
    with pytest.raises(ValueError, match="keeps the odometer's distances"):
        calibrate_drive(drive, free=("height", "distance"), joint=True)


def test_a_run_that_is_not_there_cannot_be_evaluated(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        evaluate_run(tmp_path / "nothing", Path("nowhere"))


def test_progress_comes_after_each_item():
    calls = []
    for item in watched("abc", lambda done, of: calls.append((done, of))):
        assert len(calls) == "abc".index(item)
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert list(watched([1, 2], None)) == [1, 2]
