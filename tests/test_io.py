"""What is written is read back, and the odometer's motion is what it says."""

import dataclasses
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from sofjax.geometry import SE2
from sofjax.io.camera_file import doubts, read_camera, write_camera
from sofjax.io.drive import motions, outside, read_drive
from sofjax.io.errors import InputError
from sofjax.io.map_file import read_map, write_map
from sofjax.io.settings import INLINE, read_toml, to_dict, to_toml, with_settings
from sofjax.io.text import write_atomically
from sofjax.io.trajectory import (
    Trajectory,
    TrajectoryWriter,
    gaps,
    read_trajectory,
    read_trajectory_file,
)

OFFICE = Path(__file__).parent.parent / "examples" / "office"


def test_a_trajectory_is_read_back_and_keeps_its_turns(tmp_path):
    yaw = np.linspace(-1, 9, 60)
    xy = np.random.default_rng(0).normal(size=(60, 2))
    written = Trajectory(1.6e9 + 0.1 * np.arange(60), xy, yaw)
    with TrajectoryWriter(tmp_path / "t.txt") as writer:
        for stamp, xy, turn in zip(written.stamps, written.xy, written.yaw, strict=True):
            writer.write(stamp, xy, turn)
    read = read_trajectory(tmp_path / "t.txt")
    np.testing.assert_allclose(read.stamps, written.stamps, atol=1e-6)
    np.testing.assert_allclose(read.xy, written.xy, atol=1e-6)
    np.testing.assert_allclose(read.yaw, yaw, atol=1e-8)


def test_every_row_is_on_the_disk_before_the_next(tmp_path):
    writer = TrajectoryWriter(tmp_path / "t.txt")
    for i in range(3):
        writer.write(float(i), np.zeros(2), 0.0)
        assert len(read_trajectory(tmp_path / "t.txt").stamps) == i + 1
    writer.close()


def test_comments_blank_lines_and_a_byte_order_mark_are_passed_over(tmp_path):
    text = "\ufeff# a comment\n\n0 1 2 0 0 0 0 1\r\n  # another\n1 2 2 0 0 0 0 1"
    (tmp_path / "t.txt").write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(read_trajectory(tmp_path / "t.txt").xy, [[1, 2], [2, 2]])


def test_rows_that_stand_there_twice_are_dropped_and_counted(tmp_path):
    row = "{} {} 0 0 0 0 0 1\n"
    once = [row.format(t, 0.1 * t) for t in range(6)]
    (tmp_path / "t.txt").write_text("".join(once[:3] + once[2:3] + once[3:] + once[1:2]))
    read = read_trajectory_file(tmp_path / "t.txt", "a trajectory")
    np.testing.assert_array_equal(read.trajectory.stamps, range(6))
    np.testing.assert_array_equal(read.lines, [1, 2, 3, 5, 6, 7])
    assert read.remarks == ["t.txt: 2 rows repeat another and were dropped, line 4 first"]


def test_different_poses_at_one_stamp_are_refused_with_all_their_lines(tmp_path):
    poses = [(0, 0), (1, 1), (1, 2), (2, 2), (2, 2), (3, 3), (3, 4)]
    rows = [f"{t} {x} 0 0 0 0 0 1" for t, x in poses]
    (tmp_path / "t.txt").write_text("\n".join(rows))
    with pytest.raises(InputError, match=r"t\.txt, lines 2, 3, 6, 7: a timestamp repeats"):
        read_trajectory(tmp_path / "t.txt")


@pytest.mark.parametrize("epoch", [0, 1_700_000_000_000_000_000])
def test_stamps_in_nanoseconds_are_read_as_seconds(tmp_path, epoch):
    rows = [f"{epoch + i * 40_000_000} {i} 0 0 0 0 0 1" for i in range(5)]
    (tmp_path / "t.txt").write_text("\n".join(rows))
    read = read_trajectory_file(tmp_path / "t.txt", "a trajectory")
    assert read.nanoseconds and not read.remarks
    np.testing.assert_allclose(
        read.trajectory.stamps - 1e-9 * epoch, 0.04 * np.arange(5), atol=1e-6
    )
    seconds = [f"{1_700_000_000 + 0.04 * i:.3f} {i} 0 0 0 0 0 1" for i in range(5)]
    (tmp_path / "t.txt").write_text("\n".join(seconds))
    assert not read_trajectory_file(tmp_path / "t.txt", "a trajectory").nanoseconds


def test_times_far_longer_than_usual_are_gaps():
    assert gaps(np.array([0.0, 1.0, 2.0, 3.0, 6.0, 7.0])) == [(3.0, 3.0)]
    assert gaps(np.arange(5.0)) == gaps(np.zeros(1)) == []


def test_a_camera_file_is_read_back_number_for_number(tmp_path):
    first = read_camera(OFFICE / "camera.yaml")
    assert (first.camera.width, first.camera.height) == (320, 240)
    assert float(first.mount.pitch) == pytest.approx(0.2618)
    distortion = np.array([-1e-17, 1 / 3, 3e22, 0, -0.1])
    odd = dataclasses.replace(first, distortion=distortion, name="it's")
    for i, camera_file in enumerate((first, odd)):
        write_camera(tmp_path / f"{i}.yaml", camera_file)
        read = read_camera(tmp_path / f"{i}.yaml")
        np.testing.assert_array_equal(read.camera.K, camera_file.camera.K)
        np.testing.assert_array_equal(read.distortion, camera_file.distortion)
        for field in ("x", "y", "height", "pitch", "roll", "yaw"):
            assert getattr(read.mount, field) == getattr(camera_file.mount, field)
        assert read.name == camera_file.name
        assert read.distortion_model == camera_file.distortion_model


def test_numbers_that_yaml_takes_for_words_are_numbers(tmp_path):
    text = (OFFICE / "camera.yaml").read_text().replace("0.0003", "3e-4").replace("270.0", "2.7e2")
    (tmp_path / "camera.yaml").write_text(text)
    read, first = read_camera(tmp_path / "camera.yaml"), read_camera(OFFICE / "camera.yaml")
    np.testing.assert_array_equal(read.distortion, first.distortion)
    np.testing.assert_array_equal(read.camera.K, first.camera.K)


def test_what_is_unlikely_about_a_camera_is_doubted_and_not_refused(tmp_path):
    assert doubts(read_camera(OFFICE / "camera.yaml")) == []
    text = (OFFICE / "camera.yaml").read_text().replace("159.5", "79.5").replace("0.6,", "6.0,")
    (tmp_path / "camera.yaml").write_text(text)
    assert len(doubts(read_camera(tmp_path / "camera.yaml"))) == 2


def test_a_map_is_read_back(tmp_path):
    segments = np.random.default_rng(0).normal(size=(5, 2, 2))
    write_map(tmp_path / "m.geojson", segments, np.arange(5), np.array([0, 0.1, np.nan, 0, 0]))
    read, seen = read_map(tmp_path / "m.geojson")
    np.testing.assert_allclose(read, segments, atol=1e-5)
    np.testing.assert_array_equal(seen, np.arange(5))
    document = json.loads((tmp_path / "m.geojson").read_text())
    assert document["type"] == "FeatureCollection"
    assert document["features"][1]["properties"] == {"seen": 1, "height": 0.1}
    assert "height" not in document["features"][2]["properties"]


def test_an_empty_map_is_a_map_too(tmp_path):
    write_map(tmp_path / "m.geojson", np.zeros((0, 2, 2)), np.zeros(0, int))
    read, seen = read_map(tmp_path / "m.geojson")
    assert read.shape == (0, 2, 2) and seen.shape == (0,)


def test_a_line_of_many_points_is_as_many_segments(tmp_path):
    line = {"type": "LineString", "coordinates": [[0, 0, 5], [1, 0, 5], [1, 1, 5]]}
    point = {"type": "Point", "coordinates": [0, 0]}
    features = [{"geometry": line, "properties": {"seen": 7}}, {"geometry": point}]
    (tmp_path / "m.geojson").write_text(json.dumps({"features": features}))
    read, seen = read_map(tmp_path / "m.geojson")
    np.testing.assert_array_equal(read, [[[0, 0], [1, 0]], [[1, 0], [1, 1]]])
    np.testing.assert_array_equal(seen, [7, 7])


def test_a_failed_write_leaves_the_old_file_and_nothing_beside_it(tmp_path):
    write_atomically(tmp_path / "a", "old")
    with pytest.raises(UnicodeEncodeError):
        write_atomically(tmp_path / "a", "new \ud800")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").read_text() == "old"


def test_motions_chained_are_the_odometry_between_first_and_last_image():
    drive = read_drive(OFFICE)
    steps = motions(drive)
    assert steps.shape == (286, 3)
    np.testing.assert_array_equal(steps[0], 0)
    T = SE2.identity()
    for dx, dy, dyaw in steps:
        T = T @ SE2(jnp.array([dx, dy]), jnp.asarray(dyaw, float))
    ends = drive.odometry.at(drive.image_stamps[[0, -1]])
    ends = SE2(jnp.asarray(ends.xy, float), jnp.asarray(ends.yaw, float))
    expected = SE2(ends.xy[0], ends.yaw[0]).between(SE2(ends.xy[1], ends.yaw[1]))
    np.testing.assert_allclose(T.xy, expected.xy, atol=1e-4)
    np.testing.assert_allclose(T.yaw, expected.yaw, atol=1e-4)


def test_a_motion_is_in_the_frame_of_the_robot_before_it():
    """At yaw 90 degrees a step along the world's y is a step forward."""
    drive = read_drive(OFFICE)
    stamps = np.array([0.0, 1.0, 2.0])
    odometry = Trajectory(stamps, np.array([[0, 0], [0, 1], [0, 2.0]]), np.full(3, np.pi / 2))
    drive = dataclasses.replace(drive, odometry=odometry, image_stamps=np.array([0.0, 0.5, 2.1]))
    np.testing.assert_allclose(motions(drive), [[0, 0, 0], [0.5, 0, 0], [1.5, 0, 0]], atol=1e-12)
    np.testing.assert_array_equal(outside(odometry, np.array([-0.3, -0.1, 2.1, 2.3])), [1, 0, 0, 1])


def test_the_sample_drive_is_whole():
    drive = read_drive(OFFICE)
    assert drive.name == "office"
    assert len(drive.image_files) == 286 and all(file.is_file() for file in drive.image_files)
    assert drive.groundtruth.travelled[-1] == pytest.approx(16.5, abs=0.1)
    assert drive.floor_segments.shape == (49, 2, 2)


@dataclasses.dataclass(frozen=True)
class Inner:
    sigma: float = 0.1
    exact: bool = False
    count: int = 3

    def __post_init__(self):
        if self.count == 13:
            raise ValueError("count must not be 13")


@dataclasses.dataclass(frozen=True)
class Outer:
    seed: int = 0
    rule: str = "a"
    part: Inner = dataclasses.field(default=Inner(), metadata=INLINE)
    inner: Inner = Inner(sigma=0.2)


def test_settings_have_names_with_dots():
    assert to_dict(Outer()) == {
        "seed": 0, "rule": "a", "sigma": 0.1, "exact": False, "count": 3,
        "inner.sigma": 0.2, "inner.exact": False, "inner.count": 3,
    }  # fmt: skip


def test_settings_are_changed_by_text_or_by_value():
    changed = with_settings(
        Outer(),
        {"inner.sigma": "1", "inner.exact": "True", "count": "7", "rule": "b", "sigma": 2},
        "here",
    )
    assert changed == Outer(0, "b", Inner(2.0, False, 7), Inner(1.0, True, 3))
    assert isinstance(changed.inner.sigma, float)


@pytest.mark.parametrize(
    "name, value, sentence",
    [
        ("inner.sigm", 1, "did you mean 'inner.sigma'"),
        ("inner", 1, "there is no setting 'inner'"),
        ("seed", "1.5", "'seed' is '1.5'; it must be a whole number"),
        ("seed", True, "whole number"),
        ("seed", 1.0, "whole number"),
        ("sigma", "nan", "finite"),
        ("sigma", "", "finite"),
        ("sigma", [1], "finite"),
        ("exact", "yes", "true or false"),
        ("exact", 1, "true or false"),
        ("rule", 3, "text"),
        ("inner.count", 13, "count must not be 13"),
    ],
)
def test_settings_of_the_wrong_kind_are_refused(name, value, sentence):
    with pytest.raises(InputError, match=r"^here: ") as caught:
        with_settings(Outer(), {name: value}, "here")
    assert sentence in str(caught.value)


def test_settings_are_read_back_number_for_number(tmp_path):
    settings = Outer(5, 'say "a"\n\\', Inner(1 / 3, True, 0), Inner(1e-17, False, 10**12))
    (tmp_path / "c.toml").write_text(to_toml(to_dict(settings)), encoding="utf-8")
    assert with_settings(Outer(), read_toml(tmp_path / "c.toml"), "c") == settings
