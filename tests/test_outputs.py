"""What is on the disk, whatever ends a command: nothing lost, nothing of the user's touched."""

import errno
import gc
import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest
from test_cli import make_drive

from sofjax.cli import main
from sofjax.io.camera_file import read_camera, write_camera
from sofjax.io.drive import read_drive
from sofjax.io.errors import InputError
from sofjax.io.map_file import read_map
from sofjax.io.settings import read_toml
from sofjax.io.text import write_atomically
from sofjax.io.trajectory import Trajectory, TrajectoryWriter, read_trajectory
from sofjax.pipeline import results_files, run_folder, stopping
from sofjax.pipeline.online import views
from sofjax.pipeline.stages import Closed

SMALL = ("--particles", "50")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return make_drive(tmp_path_factory.mktemp("drives") / "short", 12)


@pytest.fixture(scope="module")
def longer(tmp_path_factory):
    """Long enough for a map that has some lines."""
    return make_drive(tmp_path_factory.mktemp("drives") / "longer", 40)


def command(*args):
    return main([str(arg) for arg in args])


def report_of(folder):
    return json.loads((folder / "report.json").read_text())


def content(folder):
    """Every file below a folder, and what is in it."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def check_readable(folder):
    """Every file of a run that is there can be read, and the report tells whose the map is."""
    for path in folder.iterdir():
        match path.name:
            case "trajectory.txt" | "trajectory_smoothed.txt":
                assert path.read_bytes().endswith(b"\n")
                read_trajectory(path)
            case "map.geojson":
                read_map(path)
            case "config.toml":
                read_toml(path)
            case "report.json":
                told = json.loads(path.read_text())["map"]
                of_nothing = not len(read_map(folder / "map.geojson")[0])
                assert (folder / told["of"]).exists() or of_nothing
            case "map.png":
                assert run_folder.check_figure(path) is None
            case name:
                assert name == run_folder.MARKER or name.endswith(".sofjax-part")


# What is the user's


def test_no_command_touches_a_file_that_it_did_not_write(drive, tmp_path, monkeypatch, capfd):
    """A folder with a file of the user's by every name that sofjax writes."""
    names = [*run_folder.OF_A_RUN, run_folder.MARKER, "camera.png", "images.png", "index.html"]
    names += ["rgb.txt", "odometry.txt", "groundtruth.txt", "floor_segments.csv"]
    names += [f".{name}.part" for name in names] + [".sofjax-probe", "runs/short-inspect.png"]
    names += [".new.partial/mine", "rgb/000000.jpg", "drive/camera.yaml", "run/map.png"]
    mine = tmp_path / "mine"
    for name in names:
        (mine / name).parent.mkdir(parents=True, exist_ok=True)
        (mine / name).write_text(f"my {name}")
    before = content(mine)
    monkeypatch.chdir(mine)
    board = ("--board", "9x6", "--square", "0.03")
    for expected, *args in (
        (2, "run", drive, "--out", mine),
        (2, "run", drive, "--out", mine, "--calibrate"),
        (2, "inspect", drive, "--out", mine / "images.png"),
        (2, "inspect", drive, "--out", mine / "rgb.txt"),
        (2, "inspect", drive),
        (2, "calibrate", "mount", drive),
        (2, "calibrate", "mount", drive, "-o", mine / "new.png"),
        (2, "calibrate", "camera", drive / "rgb", *board),
        (2, "calibrate", "camera", drive / "rgb", *board, "-o", mine / "images.yaml"),
        (2, "simulate", "--out", mine, "--world", "l", "--images", "2"),
        (2, "simulate", "--out", ".", "--world", "l", "--images", "2"),
        (0, "simulate", "--out", mine / "new", "--world", "l", "--images", "2"),
        (2, "demo", "--out", mine),
        (2, "evaluate", mine, drive),
        (0, "inspect", drive, "--out", mine / "new.png"),
    ):
        assert command(*args) == expected, (args, capfd.readouterr())
        after = content(mine)
        assert {name: after.get(name) for name in before} == before, args
        assert expected == 0 or set(after) <= set(before) | {n for n in after if "new" in n}, args


def test_a_drive_is_never_written_into(drive, tmp_path, capfd):
    link = tmp_path / "link"
    link.symlink_to(drive)
    before = content(drive.parent)
    for out in (drive, drive / "rgb" / "out", drive.parent, link, link / "out"):
        assert command("run", drive, "--out", out) == 2
        assert "into the drive" in capfd.readouterr().err
        assert command("run", link, "--out", out) == 2
    assert content(drive.parent) == before
    assert not (drive / "rgb" / "out").exists()


@pytest.mark.parametrize("name", [*run_folder.OF_A_RUN, run_folder.MARKER])
def test_a_run_names_the_file_that_is_not_its_own(name, tmp_path):
    (tmp_path / name).write_text("mine")
    with (
        pytest.raises(InputError, match=name),
        run_folder.run_folder(tmp_path, "", Path("nowhere")),
    ):
        pass
    assert content(tmp_path) == {name: b"mine"}


def write_run(folder, *names):
    """What a run does to its folder."""
    with run_folder.run_folder(folder, "", Path("nowhere")):
        for name in names:
            (folder / name).write_text("a run's")


def test_what_a_run_has_written_a_later_one_replaces(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    write_run(tmp_path, "map.geojson", "report.json", "camera.yaml")
    write_run(tmp_path, "config.toml")
    assert set(content(tmp_path)) == {"notes.txt", "config.toml", run_folder.MARKER}


def test_what_the_user_has_changed_since_is_the_users(tmp_path):
    write_run(tmp_path, "map.geojson", "config.toml")
    (tmp_path / "config.toml").write_text("edited")
    before = content(tmp_path)
    for _ in range(2):
        with pytest.raises(InputError, match=r"config\.toml: is there already"):
            write_run(tmp_path)
        assert content(tmp_path) == before
    (tmp_path / "config.toml").unlink()
    (tmp_path / "map.geojson").unlink()
    (tmp_path / "map.geojson").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match=r"map\.geojson"):
        write_run(tmp_path)


def test_a_folder_of_a_run_before_there_were_markers(tmp_path):
    (tmp_path / "report.json").write_text('{"drive": "/a", "versions": {}, "calibration": null}')
    (tmp_path / "map.png").write_text("a run's")
    (tmp_path / "camera.yaml").write_text("mine: that run did not calibrate")
    with pytest.raises(InputError, match=r"camera\.yaml"):
        write_run(tmp_path)
    (tmp_path / "camera.yaml").unlink()
    write_run(tmp_path)
    assert set(content(tmp_path)) == {run_folder.MARKER}


HOLD = """
import sys, time
from pathlib import Path
from sofjax.pipeline import run_folder
with run_folder.run_folder(Path(sys.argv[1]), "", Path("nowhere")) as folder:
    (folder / "map.png").write_text("a part")
    (folder / ".report.json.0123abcd.sofjax-part").write_text("a part")
    print("in it", flush=True)
    time.sleep(600)
"""


def test_two_runs_do_not_write_into_one_folder(tmp_path):
    """The second is refused while the first lives; a killed one is no obstacle."""
    held = subprocess.Popen(
        [sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE, text=True
    )
    with held:
        assert held.stdout.readline() == "in it\n"
        before = content(tmp_path)
        with pytest.raises(InputError, match=f"the run of process {held.pid} is writing there"):
            write_run(tmp_path)
        assert content(tmp_path) == before
        held.kill()
    write_run(tmp_path)
    assert set(content(tmp_path)) == {run_folder.MARKER}


def test_runs_that_begin_in_one_second_get_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with (
        run_folder.run_folder(None, "a", Path("nowhere")) as first,
        run_folder.run_folder(None, "a", Path("nowhere")) as second,
    ):
        assert first != second


def test_a_camera_file_and_a_figure_of_sofjax_may_be_replaced(drive, tmp_path):
    camera, figure = tmp_path / "camera.yaml", tmp_path / "camera.png"
    write_camera(camera, read_camera(drive / "camera.yaml"))
    run_folder.check_camera(camera)
    camera.write_text("# the robot's\n" + camera.read_text())
    run_folder.check_camera(camera)  # a comment above does not hide whose it is
    for path in (camera, tmp_path / "new.png"):
        path.write_text("image_width: 320")
        with pytest.raises(InputError, match="is there already"):
            run_folder.check_camera(path)
    from sofjax.viewer.style import new_figure, save

    save(new_figure((1.0, 1.0))[0], figure)
    run_folder.check_figure(figure)
    with pytest.raises(InputError, match="is no camera file"):
        run_folder.check_camera(figure)


# Full disks


@contextmanager
def room(size):
    """No file may grow beyond so many bytes: as on a full disk a write does a part, then none."""
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, usual[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)


def test_a_row_without_room_is_cut_off_and_the_file_named(tmp_path):
    path = tmp_path / "t.txt"
    with TrajectoryWriter(path) as writer, room(300), pytest.raises(OSError) as off_floor:
        for i in range(9):
            writer.write(float(i), np.zeros(2), 0.0)
    assert off_floor.value.filename == str(path)
    assert len(read_trajectory(path).stamps) == i > 1
    assert path.read_bytes().endswith(b"\n")
    if Path("/dev/full").exists():
        with TrajectoryWriter(Path("/dev/full")) as writer, pytest.raises(OSError) as off_floor:
            writer.write(0.0, np.zeros(2), 0.0)
        assert off_floor.value.filename == "/dev/full" and off_floor.value.errno == errno.ENOSPC


def test_a_file_without_room_stays_as_it_was_and_is_named(tmp_path):
    path = tmp_path / "a"
    write_atomically(path, "old")
    with room(300), pytest.raises(OSError) as off_floor:
        write_atomically(path, "new" * 200)
    assert off_floor.value.filename == str(path)
    assert content(tmp_path) == {"a": b"old"}


def test_a_file_is_written_beside_under_a_name_of_its_own(tmp_path):
    (tmp_path / ".a.part").write_text("mine")
    write_atomically(tmp_path / "a", "new")
    assert content(tmp_path) == {"a": b"new", ".a.part": b"mine"}
    plain = tmp_path / "plain"
    plain.touch()
    assert (tmp_path / "a").stat().st_mode == plain.stat().st_mode


def test_a_full_disk_ends_the_drive_and_what_was_done_is_kept(drive, tmp_path, monkeypatch, capfd):
    write = TrajectoryWriter.write

    def full(writer, stamp, xy, yaw):
        if stamp > 0.5:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(writer._path))
        write(writer, stamp, xy, yaw)

    monkeypatch.setattr(TrajectoryWriter, "write", full)
    assert command("run", drive, "--out", tmp_path, *SMALL) == 1
    path = tmp_path / "trajectory.txt"
    assert capfd.readouterr().err.endswith(f"sofjax: {path}: No space left on device\n")
    check_readable(tmp_path)
    assert report_of(tmp_path)["loop"] == {"asked": "smooth", "status": "interrupted"}
    assert len(read_trajectory(path).stamps) == 6 and (tmp_path / "map.geojson").exists()


@pytest.fixture
def small_disk(tmp_path):
    """A file system with room for three pages: two files, and 4096 bytes of a trajectory."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=12k", "none", str(folder)]
    try:
        mounted = subprocess.run(mount, capture_output=True).returncode == 0
    except OSError:
        mounted = False
    if not mounted:
        pytest.skip("no file system can be mounted here")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_disk_that_is_full_in_the_middle_of_a_drive(small_disk, tmp_path, capfd):
    drive = make_drive(tmp_path / "drive", 90)
    assert command("run", drive, "--out", small_disk, *SMALL) == 1
    path = small_disk / "trajectory.txt"
    assert f"sofjax: {path}: No space left on device" in capfd.readouterr().err
    check_readable(small_disk)
    assert 4096 - 70 < path.stat().st_size <= 4096


# Signals


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


# Killed


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
