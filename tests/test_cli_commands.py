"""Ctrl-C, evaluate, inspect, help and the cache, as a user meets them."""

import os
import resource
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
from conftest import QUICK
from test_cli import FILES, IMAGES, OFFICE, SMALL, make_drive, report_of, run
from test_cli import done as done
from test_cli import drive as drive

from sofjax.cli import main
from sofjax.io.drive import read_drive
from sofjax.io.map_file import read_map
from sofjax.io.trajectory import read_trajectory
from sofjax.pipeline import RunSettings, results
from sofjax.pipeline.online import views
from sofjax.pipeline.run_log import RunLog


def test_ctrl_c_leaves_what_was_done_until_then(tmp_path, drive, monkeypatch, capfd):
    """The signal comes while the ninth image is waited for."""

    def interrupted(frontend, files):
        for i, view in enumerate(views(frontend, files)):
            if i == 8:
                raise KeyboardInterrupt
            yield view

    monkeypatch.setattr("sofjax.pipeline.online.views", interrupted)
    assert run(drive, "--out", tmp_path) == 130
    assert {path.name for path in tmp_path.iterdir()} == FILES
    assert len(read_trajectory(tmp_path / "trajectory.txt").stamps) == 8
    read_map(tmp_path / "map.geojson")
    report = report_of(tmp_path)
    assert report["interrupted"] and report["images"] == {
        "listed": IMAGES, "done": 8, "without_segments": 0, "lost": 0, "unreadable": []
    }  # fmt: skip
    assert "interrupted before 32 more" in capfd.readouterr().out


def test_ctrl_c_before_the_first_image(tmp_path, drive, monkeypatch):
    def interrupted(frontend, files):
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr("sofjax.pipeline.online.views", interrupted)
    assert run(drive, "--out", tmp_path) == 130
    assert {path.name for path in tmp_path.iterdir()} == FILES - {"map.png", "trajectory.txt"}
    assert report_of(tmp_path)["funnel"]["images"] == 0


def test_a_real_ctrl_c(tmp_path):
    # a shell's background jobs, and what they start, ignore Ctrl-C: the default is set back
    program = "import signal, runpy; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    program += "runpy.run_module('sofjax', run_name='__main__')"
    command = [sys.executable, "-c", program, "run", str(OFFICE), "--out", str(tmp_path), *SMALL]
    command += ["--particles", "5000"]  # slow enough to be caught on a busy machine
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | QUICK
    )
    trajectory, patience = tmp_path / "trajectory.txt", time.monotonic() + 300
    while not (trajectory.exists() and trajectory.read_text().count("\n") > 5):
        assert process.poll() is None and time.monotonic() < patience, process.communicate()[1]
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert "Traceback" not in err
    assert {path.name for path in tmp_path.iterdir()} == FILES
    done = len(read_trajectory(trajectory).stamps)
    assert 5 <= done < 286
    assert report_of(tmp_path)["images"]["done"] == done
    assert f"interrupted before {286 - done} more" in out


def test_evaluate_says_what_the_report_says(done, drive, capfd):
    assert main(["evaluate", str(done)]) == 0
    from_report = capfd.readouterr().out
    assert main(["evaluate", str(done), str(drive)]) == 0
    out = capfd.readouterr().out
    assert out == from_report
    errors = report_of(done)["errors"]
    assert f"{errors['trajectory']['ate_m']:.3f} m" in out
    assert f"{errors['odometry']['yaw_deg']:.2f}°" in out
    assert f"{errors['map']['precision']:.2f}" in out


def test_inspect_says_what_is_there_and_draws_it(drive, tmp_path, capfd):
    assert main(["inspect", str(drive), "--out", str(tmp_path / "a.png")]) == 0
    out = capfd.readouterr().out
    for words in ("40 of 320x240", "10.0 Hz without a gap", "0.600 m above", "49 segments"):
        assert words in out
    assert "missing   nothing" in out
    assert cv2.imread(str(tmp_path / "a.png")).shape[0] > 300


def test_inspect_names_gaps_and_what_is_missing(tmp_path, capfd):
    drive = make_drive(tmp_path / "drive")
    lines = (drive / "rgb.txt").read_text().splitlines()
    (drive / "rgb.txt").write_text("\n".join(lines[:10] + lines[20:]))
    (drive / "floor_segments.csv").unlink()
    (drive / "rgb" / "000030.jpg").write_bytes(b"")
    assert main(["inspect", str(drive), "--out", str(tmp_path / "a.png")]) == 0
    out = capfd.readouterr().out
    assert "1 gaps, the longest 1.10 s from 0.80 s on" in out
    assert "missing   true segments" in out
    assert "1 cannot be read, 000030.jpg first" in out


def test_help_answers_within_half_a_second():
    """Of the processor's time: what else the machine does is not the command's."""
    command = [sys.executable, "-m", "sofjax", "--help"]
    subprocess.run(command, check=True, capture_output=True)  # compiles the modules once
    seconds = []
    for _ in range(3):
        begun = resource.getrusage(resource.RUSAGE_CHILDREN)
        out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(ended.ru_utime + ended.ru_stime - begun.ru_utime - begun.ru_stime)
    for command in ("run", "evaluate", "inspect"):
        assert command in out
    assert min(seconds) < 0.5


def test_importing_the_library_is_light():
    code = (
        "import sys, sofjax, sofjax.cli\n"
        "heavy = {'cv2', 'matplotlib', 'scipy', 'yaml', 'tqdm'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_with_a_cache_the_second_start_compiles_nothing(drive, tmp_path):
    """Each start a process of its own: what the second had compiled would lie there too."""
    cache, kept = tmp_path / "cache", []
    for name in ("first", "second"):
        command = [sys.executable, "-m", "sofjax", "run", drive, "--out", tmp_path / name, *SMALL]
        environment = {**os.environ, **QUICK, "SOFJAX_CACHE": str(cache)}
        subprocess.run(command, env=environment, capture_output=True, check=True)
        kept.append({file.name for file in cache.glob("*-cache")})
    assert kept[0] and kept[1] == kept[0]
    for file in ("trajectory.txt", "map.geojson"):
        first, second = ((tmp_path / name / file).read_text() for name in ("first", "second"))
        assert first == second


def test_a_cache_that_cannot_be_written_is_refused(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").touch()
    monkeypatch.setenv("SOFJAX_CACHE", str(tmp_path / "file"))
    assert main(["run", "drive"]) == 2
    assert "SOFJAX_CACHE" in capsys.readouterr().err


def test_where_nothing_seen_holds_the_distance_it_is_said(done):
    """Twenty metres, a line across the way seen up to the third and again at the twelfth."""
    drive = read_drive(OFFICE)
    poses = [np.array([x, 0.0, 0.0]) for x in range(21)]
    run_log = RunLog(stamps=list(drive.image_stamps[:21]), poses=poses, across=[0] * 21)
    run_log.across[:4], run_log.across[12] = [2, 1, 3, 1], 1
    assert run_log.longest_without_across == pytest.approx(9)
    (said,) = results.warnings(drive, run_log, RunSettings())
    assert said.startswith("for 9.0 m no line across the way") and "odometer" in said
    run_log.across[7] = run_log.across[9] = run_log.across[16] = 1
    assert run_log.longest_without_across == pytest.approx(4) and not results.warnings(
        drive, run_log, RunSettings()
    )
    assert RunLog().longest_without_across == 0
    assert report_of(done)["longest_without_lines_across_m"] < 1.5
