"""What a signal, a kill or an exception leaves of a run."""

import gc
import json
import random
import signal
import subprocess
import sys
import time

import equinox as eqx
import numpy as np
import pytest
from test_cli import make_drive
from test_outputs import SMALL, check_readable, command, content, report_of
from test_outputs import drive as drive

from sofjax.io.drive import read_drive
from sofjax.io.trajectory import Trajectory, read_trajectory
from sofjax.pipeline import results_files, run_folder, stopping
from sofjax.pipeline.online import views
from sofjax.pipeline.stages import Closed


@pytest.fixture(scope="module")
def longer(tmp_path_factory):
    """Long enough for a map that has some lines."""
    return make_drive(tmp_path_factory.mktemp("drives") / "longer", 40)


def interrupt_at(monkeypatch, number, image=8):
    def interrupted(frontend, files):
        for i, view in enumerate(views(frontend, files)):
            if i == image:
                signal.raise_signal(number)
            yield view

    monkeypatch.setattr("sofjax.pipeline.online.views", interrupted)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_the_drive(number, code, drive, tmp_path, monkeypatch):
    interrupt_at(monkeypatch, number)
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)]
    assert command("run", drive, "--out", tmp_path, *SMALL) == code
    check_readable(tmp_path)
    told = report_of(tmp_path)
    assert told["interrupted"] and told["images"]["done"] == 8
    assert len(read_trajectory(tmp_path / "trajectory.txt").stamps) == 8
    after = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)]
    assert after == handlers


def test_a_signal_while_solving_leaves_what_was_driven(drive, tmp_path, monkeypatch, capfd):
    at_that_time = {}

    def close(*_):
        at_that_time.update(content(tmp_path))
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("sofjax.pipeline.finalize.close", close)
    assert command("run", drive, "--out", tmp_path, *SMALL) == 130
    check_readable(tmp_path)
    assert "interrupted while solving" in capfd.readouterr().out
    told, before = report_of(tmp_path), json.loads(at_that_time["report.json"])
    assert before["loop"] == {"asked": "smooth", "status": "not finished"}
    assert not before["interrupted"] and before["images"]["done"] == 12
    assert told["loop"] == {"asked": "smooth", "status": "interrupted"} and told["interrupted"]
    assert told["map"]["of"] == "trajectory.txt"
    assert at_that_time["map.geojson"] == (tmp_path / "map.geojson").read_bytes()
    assert "map.png" not in at_that_time and (tmp_path / "map.png").exists()
    assert not (tmp_path / "trajectory_smoothed.txt").exists()


class Killed(BaseException):
    """As a kill: nothing handles it."""


@pytest.mark.parametrize("last", ["trajectory_smoothed.txt", "map.geojson", "report.json"])
def test_a_run_killed_between_two_files_can_still_be_evaluated(
    last, longer, tmp_path, monkeypatch, capfd
):
    """What was solved is 90 degrees off what was driven: the map fits one of the two alone."""
    solved = []

    def close(driven):
        solved.append(None)
        turned = driven.final.endpoints_world[..., ::-1] * np.array([-1.0, 1.0])
        path, turn = driven.log.trajectory, np.array([[0.0, -1.0], [1.0, 0.0]])
        path = Trajectory(path.stamps, path.xy @ turn.T, path.yaw + np.pi / 2)
        report = {"lines": 1, "accepted": 0, "refused": 0}
        none = np.zeros((0, 2)), np.zeros((0, 2, 2))
        moved = eqx.tree_at(lambda final: final.endpoints_world, driven.final, turned)
        return Closed(path, moved, *none, report)

    def killed_after(name, write):
        def wrapped(path, *args):
            write(path, *args)
            if solved and path.name == name:
                raise Killed

        return wrapped

    monkeypatch.setattr("sofjax.pipeline.finalize.close", close)
    for where, name in (
        (results_files, "write_trajectory"),
        (results_files, "write_map"),
        (run_folder, "write_json"),
    ):
        monkeypatch.setattr(where, name, killed_after(last, getattr(where, name)))
    with pytest.raises(Killed):
        command("run", longer, "--out", tmp_path, *SMALL)
    check_readable(tmp_path)
    told = report_of(tmp_path)
    assert told["loop"]["status"] == ("solved" if last == "report.json" else "not finished")
    capfd.readouterr()
    assert command("evaluate", tmp_path) == 0
    (precision,) = (
        float(line.split()[-1])
        for line in capfd.readouterr().out.splitlines()
        if "map, precision" in line
    )
    assert precision > 0.5


def test_held_signals_wait_and_others_do_not(capfd):
    done = []
    with stopping.listening():
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    with stopping.listening(), pytest.raises(KeyboardInterrupt):
        with stopping.held():
            signal.raise_signal(signal.SIGTERM)
            done.append("after the signal")
            with stopping.allowed():
                done.append("not this")
    assert done == ["after the signal"] and stopping.exit_code() == 143
    with stopping.listening(), pytest.raises(KeyboardInterrupt):
        with stopping.held():
            signal.raise_signal(signal.SIGTERM)
        raise AssertionError("held ends by what was kept waiting")


def test_who_insists_is_not_kept_waiting(monkeypatch):
    with stopping.listening(), pytest.raises(KeyboardInterrupt):
        with stopping.held():
            for _ in range(3):  # along with the first, as from a wrapper of the command
                signal.raise_signal(signal.SIGINT)
            monkeypatch.setattr(stopping, "SECOND", 0.0)
            signal.raise_signal(signal.SIGINT)
            raise AssertionError("the second is raised at once")


def wait():
    for _ in range(1000):
        time.sleep(0.01)
    raise AssertionError("the signal was lost")


def test_an_import_is_not_cut_short(tmp_path, monkeypatch):
    (tmp_path / "stopped_module.py").write_text(
        "import signal\nsignal.raise_signal(signal.SIGINT)\nwhole = True\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with stopping.listening(), pytest.raises(KeyboardInterrupt):
        import stopped_module

        assert stopped_module.whole
        wait()
    assert sys.modules.pop("stopped_module").whole


def test_an_interrupt_that_a_callback_swallows_comes_again(capfd):
    def callback(phase, _):
        if phase == "start" and callback in gc.callbacks:
            gc.callbacks.remove(callback)
            signal.raise_signal(signal.SIGINT)

    with stopping.listening(), pytest.raises(KeyboardInterrupt):
        gc.callbacks.append(callback)
        gc.collect()
        wait()
    assert not capfd.readouterr().err


def test_what_the_parent_ignores_stays_ignored():
    usual = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with stopping.listening():
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, usual)


def test_a_stopped_command_does_not_wait_for_its_threads():
    program = "import sys, threading, sofjax.cli, sofjax.__main__\n"
    program += "timer = threading.Timer(100, print)\n"
    program += "sofjax.cli.main = lambda: timer.start() or print('said') or 143\n"
    program += "sys.exit(sofjax.__main__.main())"
    words = [sys.executable, "-c", program]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (143, "said\n", "")


def start(drive, out):
    program = "import signal, runpy; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    program += "runpy.run_module('sofjax', run_name='__main__')"
    words = [sys.executable, "-c", program, "run", str(drive), "--out", str(out), *SMALL]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_run_ended_while_it_solves_has_its_map_and_report(number, drive, tmp_path):
    process, patience = start(drive, tmp_path), time.monotonic() + 300
    while not (tmp_path / "report.json").exists():
        assert process.poll() is None and time.monotonic() < patience, process.communicate()[1]
        time.sleep(0.01)
    process.send_signal(number)
    _, err = process.communicate(timeout=120)
    assert "Traceback" not in err
    assert process.returncode == (-9 if number == signal.SIGKILL else 143)
    check_readable(tmp_path)
    told, status = report_of(tmp_path), {9: "not finished"}.get(number, "interrupted")
    assert told["loop"] == {"asked": "smooth", "status": status}
    assert told["images"]["done"] == len(read_drive(drive).image_files)
    assert (tmp_path / "map.geojson").exists()


@pytest.mark.slow
def test_a_run_may_be_killed_at_any_moment(drive, tmp_path):
    for out in ("whole", "again"):  # the first compiles what the others read
        begun = time.monotonic()
        whole = start(drive, tmp_path / out)
        whole.communicate()
        assert whole.returncode == 0
        life = time.monotonic() - begun
    draw, reached = random.Random(0), set()
    for i in range(20):
        out = tmp_path / str(i)
        process = start(drive, out)
        time.sleep(draw.uniform(0, life))
        process.kill()
        process.communicate()
        if out.exists():
            check_readable(out)
            reached.add(frozenset(content(out)))
    assert len(reached) >= 3  # moments before, in and after the drive
