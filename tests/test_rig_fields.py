"""Clock, shutter and odometer in `camera.yaml`: read, written, refused, and used."""

import dataclasses
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_camera_file import MOUNT, ROS

from sofjax.extraction.observation import LAGS
from sofjax.geometry import Segments
from sofjax.io.camera_file import read_camera, write_camera
from sofjax.io.drive import motions, read_drive, ways_around
from sofjax.io.errors import InputError
from sofjax.io.rig_fields import RigFields
from sofjax.io.settings import to_dict, with_settings
from sofjax.io.trajectory import TrajectoryWriter
from sofjax.motion import prior_bias
from sofjax.pipeline import RunSettings
from sofjax.rig import retaken
from sofjax.vision import ImageSegments
from sofjax.vision.observe import observations

OFFICE = Path(__file__).parent.parent / "examples" / "office"
FIELDS = """\
time_offset: -0.11
line_delay: 2.5e-05
odometer: {distance: 0.02, left: -0.01, right: 0.03, curvature: 0.002}
sigma: {height: 0.012, focal: 0.004, time_offset: 0.003, left: 0.01}
"""


@pytest.fixture
def read(tmp_path):
    """Read the sample of ROS with some more fields."""

    def call(text):
        (tmp_path / "camera.yaml").write_text(ROS + MOUNT + text)
        return read_camera(tmp_path / "camera.yaml")

    return call


def test_the_fields_are_read(read):
    file = read(FIELDS)
    assert file.rig_fields == RigFields(
        -0.11, 2.5e-5, (0.02, -0.01, 0.03, 0.002),
        {"height": 0.012, "focal": 0.004, "time_offset": 0.003, "left": 0.01},
    )  # fmt: skip
    assert float(file.rig.time_offset) == pytest.approx(-0.11)
    assert float(file.rig.line_delay) == pytest.approx(2.5e-5)
    assert file.rig.lens.coefficients[:2] == pytest.approx([-0.3, 0.1])


def test_what_is_not_there_is_zero_and_is_not_written(read, tmp_path):
    for text in ("", "time_offset:\nline_delay: null\nodometer: {}\nsigma:\n"):
        file = read(text)
        assert file.rig_fields == RigFields()
        write_camera(tmp_path / "again.yaml", file)
        written = (tmp_path / "again.yaml").read_text()
        assert not any(word in written for word in ("time_offset", "odometer", "sigma", "delay"))
    assert read("odometer: {left: 0.02}\n").rig_fields.odometer == (0.0, 0.02, 0.0, 0.0)


@pytest.mark.parametrize(
    "clock",
    [
        RigFields(-0.11, 2.5e-5, (0.02, -0.01, 0.03, 0.002), {"height": 0.012, "left": 0.01}),
        RigFields(
            1 / 3, -1e-5 / 3, (0.0, 1 / 7, 0.0, -1e-7 / 3), {"k1": 1 / 3, "line_delay": 1e-9 / 7}
        ),
        RigFields(odometer=(0.0, 0.0, 0.0, 0.1 + 0.2)),
        RigFields(time_offset=1e-5 / 3),
    ],
)
def test_what_is_written_is_read_back_number_for_number(read, tmp_path, clock):
    write_camera(tmp_path / "again.yaml", dataclasses.replace(read(""), rig_fields=clock))
    assert read_camera(tmp_path / "again.yaml").rig_fields == clock


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time_offset: .nan", "'time_offset'"),
        ("time_offset: late", "'time_offset'"),
        ("time_offset: 110", "'time_offset' is 110; it must be in seconds, at most 10 either way"),
        ("line_delay: .inf", "'line_delay'"),
        ("line_delay: 0.03", "'line_delay' is 0.03; it must be in seconds from row to row"),
        ("odometer: 0.02", "'odometer'"),
        ("odometer: [0.02, 0, 0, 0]", "'odometer'"),
        ("odometer: {lfet: 0.02}", "'odometer' has no field 'lfet'; did you mean 'left'"),
        ("odometer: {left: 1.02}", "'left' of 'odometer' is 1.02; it must be a share"),
        ("odometer: {left: .nan}", "'left'"),
        ("sigma: 0.1", "'sigma'"),
        ("sigma: {hight: 0.1}", "'sigma' has no field 'hight'; did you mean 'height'"),
        ("sigma: {height: -0.1}", "'height' of 'sigma' is -0.1; a standard deviation must not be"),
        ("sigma: {height: .inf}", "'height'"),
        ("odometer: {3: 0.02}", "'odometer' has no field '3'"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_with_file_and_field(read, tmp_path, text, words):
    with pytest.raises(InputError) as error:
        read(text + "\n")
    assert str(error.value).startswith(f"{tmp_path / 'camera.yaml'}: ")
    assert words in str(error.value)


@pytest.mark.parametrize(
    "text", ["time_offset: 0\n", "odometer: false\n", "sigma: []\n", "odometer: 0\n"]
)
def test_nothing_is_a_number_and_no_mapping(read, text):
    if "time_offset" in text:
        assert read(text).rig_fields == RigFields()
    else:
        with pytest.raises(InputError, match=text.split(":")[0]):
            read(text)


# In use


def make_drive(folder, fields="", shift=0.0, images=24):
    """The first images' names of the sample, another clock in its camera file or its odometry."""
    (folder / "rgb").mkdir(parents=True)
    shutil.copy(OFFICE / "camera.yaml", folder)
    with open(folder / "camera.yaml", "a") as file:
        file.write(fields)
    for i in range(images):
        (folder / "rgb" / f"{i:06d}.jpg").touch()
    lines = (OFFICE / "rgb.txt").read_text().splitlines()[30 : images + 30]
    rows = [f"{line.split()[0]} rgb/{i:06d}.jpg\n" for i, line in enumerate(lines)]
    (folder / "rgb.txt").write_text("".join(rows))
    odometry = read_drive(OFFICE).odometry
    with TrajectoryWriter(folder / "odometry.txt") as writer:
        for stamp, xy, yaw in zip(odometry.stamps, odometry.xy, odometry.yaw, strict=True):
            writer.write(stamp + shift, xy, yaw)
    return read_drive(folder)


def test_a_time_offset_reads_as_an_odometry_of_shifted_stamps(tmp_path):
    """The images are 0.11 s late: what the odometer read 0.11 s before is when they were taken."""
    offset = make_drive(tmp_path / "offset", "time_offset: -0.11\n")
    shifted = make_drive(tmp_path / "shifted", shift=0.11)
    plain = make_drive(tmp_path / "plain")
    np.testing.assert_allclose(motions(offset), motions(shifted), atol=1e-7)
    around = [ways_around(drive, LAGS) for drive in (offset, shifted)]
    np.testing.assert_allclose(*around, atol=1e-6)
    assert np.abs(motions(offset) - motions(plain)).max() > 1e-3
    np.testing.assert_array_equal(offset.image_stamps, plain.image_stamps)


def test_the_ways_around_an_image_are_those_of_the_poses(tmp_path):
    drive = make_drive(tmp_path / "drive")
    around = ways_around(drive, LAGS)
    assert around.shape == (24, len(LAGS), 3)
    np.testing.assert_allclose(around[:, 7], 0, atol=1e-12)  # no way at no lag
    here, there = (drive.odometry.at(drive.image_stamps + lag) for lag in (0.0, LAGS[11]))
    for i in range(24):
        x, y, turn = around[i, 11]
        # the exponential by Taylor's series
        M = np.array([[0, -turn, x], [turn, 0, y], [0, 0, 0]])
        E = np.eye(3) + M + M @ M / 2 + M @ M @ M / 6 + M @ M @ M @ M / 24
        c, s = np.cos(here.yaw[i]), np.sin(here.yaw[i])
        want = np.array([[c, s], [-s, c]]) @ (there.xy[i] - here.xy[i])
        np.testing.assert_allclose(E[:2, 2], want, atol=1e-5)
        assert turn == pytest.approx(there.yaw[i] - here.yaw[i])


def test_a_drive_whose_clocks_never_meet_is_refused(tmp_path):
    with pytest.raises(InputError, match="never meet"):
        make_drive(tmp_path / "drive", "time_offset: 9.9\n", shift=-200.0)


def test_a_line_delay_puts_all_rows_at_the_stamp(tmp_path):
    """What is observed is what a camera that takes all rows at once would have seen."""
    drive = make_drive(tmp_path / "drive", "line_delay: 1.0e-4\n", images=3)
    ends = jnp.array([[[40.0, 200.0], [280.0, 190.0]]] * 3)
    view = ImageSegments(Segments(ends[0][None], jnp.ones(1, bool)), 0, 1, "", {})
    (*_, (_, observed)) = observations(drive, [view] * 1 + [
        dataclasses.replace(view, segments_image=Segments(ends[:1] + i, jnp.ones(1, bool)))
        for i in (1.0, 2.0)
    ])  # fmt: skip
    rig = drive.camera_file.rig
    at_once = dataclasses.replace(rig, line_delay=jnp.zeros(()))
    want = jax.vmap(lambda x: retaken(at_once, rig, observed.around, x))(ends[0] + 2.0)
    got = observed.segments_image.endpoints[0]
    np.testing.assert_allclose(got, want, atol=1e-3)
    assert float(jnp.abs(got - ends[0] - 2.0).max()) > 0.1


def test_a_run_begins_with_the_odometer_that_the_file_knows(read):
    file = read("odometer: {distance: 0.02, left: -0.01, curvature: 0.002}\n")
    settings = RunSettings().on(file)
    np.testing.assert_allclose(prior_bias(settings.slam.motion).mean, [0.02, -0.01, 0.0, 0.002])
    assert RunSettings().on(read("")) == RunSettings()
    assert to_dict(settings)["motion.left_error"] == -0.01


def test_an_error_of_the_odometer_that_the_user_sets_stays(read):
    settings = with_settings(RunSettings(), {"motion.left_error": 0.05}, "here")
    on = settings.on(read("odometer: {left: 0.02, right: 0.03}\n")).slam.motion
    assert (on.left_error, on.right_error, on.distance_error) == (0.05, 0.03, 0)
