"""What is on the disk, whatever ends a command: nothing lost, nothing of the user's touched."""

import errno
import json
import os
import resource
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from test_cli import make_drive

from sofjax.cli import main
from sofjax.io.camera_file import read_camera, write_camera
from sofjax.io.errors import InputError
from sofjax.io.map_file import read_map
from sofjax.io.settings import read_toml
from sofjax.io.text import write_atomically
from sofjax.io.trajectory import TrajectoryWriter, read_trajectory
from sofjax.pipeline import run_folder

SMALL = ("--particles", "50")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return make_drive(tmp_path_factory.mktemp("drives") / "short", 12)


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
