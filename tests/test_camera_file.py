"""Calibrations that other tools write are read, and what contradicts itself is refused."""

import cv2
import numpy as np
import pytest

from sofjax.io.camera_file import (
    doubts,
    known_mount,
    read_camera,
)
from sofjax.io.errors import InputError
from sofjax.vision import Lens

K = [[500.0, 0.0, 321.5], [0.0, 502.0, 239.0], [0.0, 0.0, 1.0]]
FLAT = [value for row in K for value in row]
D = [-0.3, 0.1, 0.001, -0.002, 0.01]
MOUNT = "mount: {height: 0.6, pitch: 0.2618}\n"

ROS = f"""\
image_width: 640
image_height: 480
camera_name: narrow
camera_matrix: {{rows: 3, cols: 3, data: {FLAT}}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: {D}}}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
"""
LINES = "".join(f"- {value}\n" for value in FLAT)
TOPIC = f"""\
header:
  stamp: {{sec: 3, nanosec: 5}}
  frame_id: camera
height: 480
width: 640
distortion_model: plumb_bob
d: {D}
k:
{LINES}r: [1, 0, 0, 0, 1, 0, 0, 0, 1]
p: [500.0, 0, 321.5, 0, 0, 502.0, 239.0, 0, 0, 0, 1, 0]
binning_x: 0
roi: {{x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}}
"""
ROS_1 = TOPIC.replace("d: [", "D: [").replace("k:\n", "K:\n").replace("plumb_bob", '"plumb_bob"')
OPENCV = """\
%YAML:1.0
---
calibration_time: "Fri Nov 27 15:00:00 2026"
nr_of_frames: 20
image_width: 640
image_height: 480
board_width: 9
square_size: 3.0e-02
flags: 0
fisheye_model: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.0e+02, 0., 3.215e+02, 0., 5.02e+02,
       2.39e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -3.0e-01, 1.0e-01, 1.0e-03, -2.0e-03,
       1.0e-02 ]
avg_reprojection_error: 2.1e-01
"""
OLD_OPENCV = (
    OPENCV.replace("camera_matrix", "Camera_Matrix")
    .replace("distortion_coefficients", "Distortion_Coefficients")
    .replace("image_width", "image_Width")
    .replace("fisheye_model: 0\n", "")
)
KALIBR = f"""\
cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: {D[:4]}
  distortion_model: radtan
  intrinsics: [500.0, 502.0, 321.5, 239.0]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
"""
FORMS = {
    "ROS's file": ROS,
    "ROS 2's topic": TOPIC,
    "ROS 1's topic": ROS_1,
    "OpenCV": OPENCV,
    "OpenCV's sample of old": OLD_OPENCV,
    "Kalibr": KALIBR,
    "rows": ROS.replace(f"{{rows: 3, cols: 3, data: {FLAT}}}", str(K)),
    "rows in data": ROS.replace(str(FLAT), str(K)),
    "a column of rows": ROS.replace(str(D), str([[value] for value in D])),
    "a document's end": ROS + "...\n",
}


@pytest.fixture
def read(tmp_path):
    """Read a text as a camera file."""

    def call(text):
        (tmp_path / "camera.yaml").write_text(text)
        return read_camera(tmp_path / "camera.yaml")

    return call


@pytest.fixture
def refused(read):
    """The sentence that refuses a text as a camera file."""

    def call(text):
        with pytest.raises(InputError) as error:
            read(text)
        return str(error.value)

    return call


@pytest.mark.parametrize("form", FORMS)
def test_what_other_tools_write_is_read(read, form):
    found = read(FORMS[form].removesuffix("...\n") + MOUNT)
    assert (found.camera.width, found.camera.height) == (640, 480)
    np.testing.assert_array_equal(found.camera.K, K)
    np.testing.assert_array_equal(found.distortion, D[:4] if form == "Kalibr" else D)
    assert found.distortion_model == "plumb_bob"
    assert len(doubts(found)) == (form == "OpenCV's sample of old")  # it names no model


def test_a_document_that_has_ended_takes_the_mount_before_or_after(read):
    first = read(ROS + MOUNT)
    for text in (TOPIC + MOUNT + "---\n", TOPIC + "---\n" + MOUNT, ROS + MOUNT + "...\n"):
        again = read(text)
        np.testing.assert_array_equal(again.camera.K, first.camera.K)
        assert float(again.mount.height) == float(first.mount.height)


def test_opencv_itself_writes_what_is_read(tmp_path):
    storage = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array(K))
    storage.write("distortion_coefficients", np.array([D]))
    storage.release()
    with open(tmp_path / "camera.yaml", "a") as file:
        file.write(MOUNT)
    found = read_camera(tmp_path / "camera.yaml")
    np.testing.assert_array_equal(found.camera.K, K)
    np.testing.assert_array_equal(found.distortion, D)
    assert doubts(found) == ["the camera file has no 'distortion_model': plumb_bob is supposed"]


LENSES = {
    "4": ("plumb_bob", D[:4], "plumb_bob", D[:4]),
    "8 that are 5": ("plumb_bob", [*D, 0, 0, 0], "plumb_bob", D),
    "14 that are 5": ("plumb_bob", D + 9 * [0.0], "plumb_bob", D),
    "radtan": ("RadTan", D[:4], "plumb_bob", D[:4]),
    "another case": ("Plumb_Bob", D, "plumb_bob", D),
    "rational of 5": ("rational_polynomial", D, "rational_polynomial", D),
    "rational": ("rational_polynomial", [*D, 1, 2, 3], "rational_polynomial", [*D, 1, 2, 3]),
    "thin prism": ("rational_polynomial", [*D, *7 * [0.01]], "rational_polynomial",
        [*D, *7 * [0.01]]),
    "tilted": ("rational_polynomial", [*D, *9 * [0.01]], "rational_polynomial", [*D, *9 * [0.01]]),
    "fisheye": ("fisheye", [0.1, 0.2, 0.3, 0.4], "equidistant", [0.1, 0.2, 0.3, 0.4]),
    "fisheye of 5": ("equidistant", [0.1, 0.2, 0.3, 0.4, 0], "equidistant", [0.1, 0.2, 0.3, 0.4]),
    "none": ("none", [0.0] * 5, "plumb_bob", [0.0] * 5),
    "nothing": ("''", [0, 0, 0, 0], "plumb_bob", [0.0] * 5),
    "none of none": ("none", [], "plumb_bob", [0.0] * 5),
}  # fmt: skip


@pytest.mark.parametrize("name", LENSES)
def test_lenses(read, name):
    word, given, model, distortion = LENSES[name]
    text = ROS.replace("plumb_bob", word).replace(str(D), str(given)) + MOUNT
    found = read(text)
    assert found.distortion_model == model and doubts(found) == []
    np.testing.assert_array_equal(found.distortion, distortion)


def test_a_lens_of_thin_prisms_undistorts_as_opencv_has_it(read):
    prisms = [-0.3, 0.1, 0.001, -0.002, 0.01, 0.02, -0.01, 0.003, 0.002, -0.001, 0.003, 0.001]
    text = ROS.replace("plumb_bob", "rational_polynomial").replace(str(D), str(prisms))
    points = np.array([[100.0, 80.0], [600.0, 400.0]])
    right = cv2.undistortPoints(points[:, None], np.array(K), np.array(prisms), P=np.array(K))
    found = Lens(read(text + MOUNT)).undistort_points(points)
    np.testing.assert_allclose(found, right[:, 0], atol=1e-6)
    assert np.abs(found - points).max() > 5


def test_no_coefficients_at_all_are_no_distortion(read):
    rows = [row for row in ROS.splitlines() if "coefficients" not in row]
    found = read("\n".join(rows).replace("plumb_bob", "none") + "\n" + MOUNT)
    np.testing.assert_array_equal(found.distortion, np.zeros(5))


def test_a_model_that_is_missing_is_supposed_and_doubted(read):
    for numbers, model in ((D, "plumb_bob"), ([*D, 1.0, 0.0, 0.0], "rational_polynomial")):
        text = ROS.replace("distortion_model: plumb_bob\n", "").replace(str(D), str(numbers))
        found = read(text + MOUNT)
        assert found.distortion_model == model
        assert any(f"{model} is supposed" in doubt for doubt in doubts(found))


def test_opencv_says_which_lens_is_a_fisheye(read):
    text = OPENCV.replace("fisheye_model: 0", "fisheye_model: 1").replace("1.0e-02 ]", "0. ]")
    found = read(text + MOUNT)
    assert found.distortion_model == "equidistant" and doubts(found) == []


WRONG = {
    "two sizes": (ROS + "width: 320\n", "'image_width' and 'width' contradict"),
    "two matrices": (ROS + "k: [1, 0, 320, 0, 1, 240, 0, 0, 1]\n", "'camera_matrix' and 'k' contr"),
    "two lenses": (ROS + "d: [0, 0, 0, 0, 0]\n", "'distortion_coefficients' and 'd' contradict"),
    "two models": (ROS + "fisheye_model: 1\n", "'distortion_model' and 'fisheye_model' contradict"),
    "two messages": (TOPIC + "---\n" + TOPIC, "2 documents parted by '---'"),
    "two cameras": (KALIBR + KALIBR.replace("cam0", "cam1"), "holds cam0 and cam1; keep the one"),
    "an omni camera": (KALIBR.replace("pinhole", "omni"), "'camera_model' is 'omni'; it must be"),
    "not calibrated": (ROS.replace(str(FLAT), str([0.0] * 9)), "'camera_matrix' is all zeros"),
    "3 intrinsics": (KALIBR.replace("500.0, ", ""), "'intrinsics' has 3 numbers and must have 4"),
    "one resolution": (KALIBR.replace("[640, 480]", "640"), "'resolution' is 640; it must be ["),
    "half a resolution": (KALIBR.replace("640", "640.5"), "'resolution' is 640.5; it must be"),
    "a surplus": (ROS.replace(str(D), str([*D, 1, 0, 0])), "must be zero after the first 5"),
    "6 numbers": (ROS.replace(str(D), str([*D, 0])), "6 numbers and must have 4 or 5 or 8"),
    "none that is some": (ROS.replace("plumb_bob", "none"), "names none and 'distortion_coeff"),
    "no coefficients": (ROS.replace(str(D), "[]"), "has 0 numbers and must have 4"),
    "rows of unequal lengths": (ROS.replace(str(FLAT), "[[1, 2, 3], [4], [5, 6, 7, 8, 9]]"),
        "'camera_matrix' has 3 numbers and must have 9"),
    "a slip in the model's name": (ROS.replace("distortion_model: plumb_bob", "distortion_modle: "
        "equidistant"), "'distortion_model' is missing; did you mean 'distortion_modle'"),
    "a mount twice": (KALIBR + "  mount: {height: 1, pitch: 0.1}\n", "'mount' stands both in"),
}  # fmt: skip


@pytest.mark.parametrize("fault", WRONG)
def test_what_contradicts_itself_is_refused(refused, fault):
    text, sentence = WRONG[fault]
    assert sentence in refused(text + MOUNT)


@pytest.mark.parametrize("form", FORMS)
def test_every_form_wants_a_mount(refused, form):
    assert "the field 'mount' is missing; it says where the camera sits" in refused(FORMS[form])


def test_a_hint_never_names_what_is_used(refused):
    rows = [row for row in ROS.splitlines() if "image_height" not in row]
    assert refused("\n".join(rows)).endswith("the field 'image_height' is missing")
    rows = [row for row in ROS.splitlines() if "distortion_coefficients" not in row]
    assert refused("\n".join(rows)).endswith("the field 'distortion_coefficients' is missing")


def test_the_mount_of_another_tools_file_is_known(tmp_path):
    (tmp_path / "camera.yaml").write_text(KALIBR + "mount: {height: 0.6}\n")
    assert known_mount(tmp_path / "camera.yaml") == {"height": 0.6}
