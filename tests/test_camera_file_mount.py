"""Angles of a mount at their limits, and that what is written is read back."""

import math
import string

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sofjax.cli import main
from sofjax.geometry import Camera, Mount
from sofjax.io.camera_file import (
    MOUNT_FIELDS,
    CameraFile,
    mount_fields,
    read_camera,
    write_camera,
    write_intrinsics,
)
from sofjax.io.errors import InputError

K = [[500.0, 0.0, 321.5], [0.0, 502.0, 239.0], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    "text, key, angle",
    [
        ("pitch=1.5708", "pitch", math.pi / 2),
        ("pitch=1.571", "pitch", math.pi / 2),
        ("pitch=-1.5708", "pitch", -math.pi / 2),
        ("roll=3.1416", "roll", 3.1416 - 2 * math.pi),
        ("roll=3.14159", "roll", 3.14159),
        ("roll=3.1486", "roll", 3.1486 - 2 * math.pi),
        ("roll=-3.141592653589793", "roll", math.pi),
        ("yaw=6.2832", "yaw", 6.2832 - 2 * math.pi),
        ("yaw=-6.2832", "yaw", 2 * math.pi - 6.2832),
    ],
)
def test_angles_are_limited_where_the_world_rounds(text, key, angle):
    assert mount_fields("--mount", text)[key] == pytest.approx(angle, abs=1e-12)


@pytest.mark.parametrize("text", ["pitch=1.58", "pitch=15", "roll=6.3", "roll=-90", "yaw=7"])
def test_angles_in_degrees_are_refused(text):
    with pytest.raises(InputError, match=r"angles are in radians.*\(15 degrees are 0.2618\)"):
        mount_fields("--mount", text)


def rotation(pitch, roll, yaw):
    """R = Rz(yaw) Ry(pitch) Rx(roll), in float64."""
    about = lambda i, a: cv2.Rodrigues(a * np.eye(3)[i])[0]
    return about(2, yaw) @ about(1, pitch) @ about(0, roll)


ANGLE = st.floats(-20.0, 20.0)
METRES = st.floats(-50, 50, width=32)
NAMES = st.text(max_size=20)
NUMBERS = st.floats(-1e6, 1e6)
DISTORTIONS = st.one_of(
    st.tuples(st.just("plumb_bob"), st.lists(NUMBERS, min_size=4, max_size=5)),
    st.tuples(st.just("equidistant"), st.lists(NUMBERS, min_size=4, max_size=4)),
    *(
        st.tuples(st.just("rational_polynomial"), st.lists(NUMBERS, min_size=n, max_size=n))
        for n in (8, 12, 14)
    ),
)
FILES = settings(
    max_examples=150,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@FILES
@given(
    angles=st.tuples(ANGLE, ANGLE, ANGLE), lens=DISTORTIONS, name=NAMES, x=METRES, y=METRES,
    height=st.floats(0.0009765625, 50, width=32), note=NAMES,
)  # fmt: skip
def test_whatever_is_fitted_is_written_to_be_read(
    tmp_path, angles, lens, name, x, y, height, note
):  # fmt: skip
    """Of any angles: a fit turns as far as it likes, and may pass the vertical."""
    camera = Camera(jnp.asarray(K, float), 640, 480)
    values = dict(zip(MOUNT_FIELDS, (x, y, height, *angles), strict=True))
    path, (model, distortion) = tmp_path / "camera.yaml", lens
    write_intrinsics(path, camera, model, np.array(distortion), name, values, [note])
    try:
        found = read_camera(path)
    except InputError as error:
        assert "above the horizon" in str(error)
        return
    np.testing.assert_array_equal(found.camera.K, camera.K)
    np.testing.assert_array_equal(found.distortion, distortion)
    assert found.distortion_model == model
    assert found.name == "".join(c for c in name if c.isprintable())
    for key in ("x", "y", "height"):
        assert float(getattr(found.mount, key)) == values[key]
    again = [float(getattr(found.mount, key)) for key in ("pitch", "roll", "yaw")]
    atol = 2e-3 if abs(again[0]) > 1.5697 else 1e-5  # a pitch within a rounding of 90° is clamped
    np.testing.assert_allclose(rotation(*again), rotation(*angles), atol=atol)
    assert abs(again[0]) <= np.float32(math.pi / 2)
    assert all(abs(angle) <= np.float32(math.pi) for angle in again)
    write_camera(path, found)  # and then stays as it is
    text = path.read_text()
    write_camera(path, read_camera(path))
    assert path.read_text() == text


@FILES
@given(
    st.floats(-90, 90), st.floats(-180, 180), st.floats(-180, 180), st.floats(0.01, 2.7),
    st.sampled_from([string.ascii_letters, "it's: #1", "ü"]),
)  # fmt: skip
def test_whatever_is_simulated_is_written_to_be_read(tmp_path, pitch, roll, yaw, height, name):
    mount = Mount.create(height, np.radians(pitch), roll=np.radians(roll), yaw=np.radians(yaw))
    camera = Camera(jnp.asarray(K, float), 640, 480)
    write_camera(
        tmp_path / "camera.yaml", CameraFile(camera, mount, np.zeros(5), "plumb_bob", name)
    )
    try:
        found = read_camera(tmp_path / "camera.yaml")
    except InputError as error:
        assert "above the horizon" in str(error)
        return
    assert float(found.mount.height) == float(mount.height)
    angles = [
        [float(getattr(m, k)) for k in ("pitch", "roll", "yaw")] for m in (found.mount, mount)
    ]
    np.testing.assert_allclose(rotation(*angles[0]), rotation(*angles[1]), atol=1e-5)


@pytest.mark.parametrize("tilt", [["--pitch", "90"], ["--roll", "180"], ["--yaw", "-180"]])
def test_a_drive_at_the_limit_is_simulated_and_read(tmp_path, tilt, capfd):
    drive = str(tmp_path / "drive")
    args = ["--world", "l", "--images", "2", "--size", "64x48", "--out", drive]
    assert main(["simulate", *args, *tilt]) == 0
    assert main(["inspect", drive, "--out", str(tmp_path / "a.png")]) == 0
    assert "warning" not in capfd.readouterr().out


def test_a_remark_reaches_the_user(tmp_path, capfd):
    drive = tmp_path / "drive"
    args = ["--world", "l", "--images", "2", "--size", "64x48", "--out", str(drive)]
    assert main(["simulate", *args]) == 0
    text = (drive / "camera.yaml").read_text()
    (drive / "camera.yaml").write_text(text.replace("distortion_model: plumb_bob\n", ""))
    assert main(["inspect", str(drive), "--out", str(tmp_path / "a.png")]) == 0
    said = capfd.readouterr().out
    assert "warning   the camera file has no 'distortion_model': plumb_bob is supposed" in said
