"""The front end: where an edge is, what a lens does to it, and what is kept of it."""

import struct
import subprocess
import sys
import zlib

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from sofjax.geometry import Camera, Mount
from sofjax.geometry.floor import floor_homography, horizon
from sofjax.geometry.se2 import SE2
from sofjax.io.camera_file import CameraFile, horizon_image
from sofjax.vision import (
    Frontend,
    FrontendSettings,
    ImageSegments,
    Lens,
    detect_hough,
    detect_lsd,
    pack,
    read_image,
    without_repeats,
)

MIDDLE = 99.5  # of a 200 px image, whole numbers being the middles of pixels


def camera_file(distortion=(0.0,) * 5, model="plumb_bob", size=(320, 240), f=270.0, pitch=0.26):
    width, height = size
    K = jnp.array([[f, 0.0, (width - 1) / 2], [0.0, f, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return CameraFile(
        Camera(K, width, height), Mount.create(0.6, pitch), np.array(distortion), model, "test"
    )


def drawn_edge(angle, offset):
    """An image of a step from dark to bright, each pixel the mean of its own area.

    The edge is n·(x - MIDDLE) = offset with n = (cos, sin) of the angle.
    """
    fine = 16
    centres = (np.arange(200 * fine) + 0.5) / fine - 0.5 - MIDDLE
    n = np.cos(angle), np.sin(angle)
    bright = n[0] * centres[None] + n[1] * centres[:, None] > offset
    area = bright.reshape(200, fine, 200, fine).mean(axis=(1, 3))
    return np.round(cv2.GaussianBlur(50 + 150 * area, (0, 0), 0.7)).astype(np.uint8)


def offsets(segments, angle):
    """Where the end points [S, 2] of the segments lie along the normal."""
    return (segments.reshape(-1, 2, 2) - MIDDLE) @ [np.cos(angle), np.sin(angle)]


ANGLES = np.deg2rad([0, 10, 30, 45, 90, 135, 180, 225, 270, 300])


@pytest.mark.parametrize("angle", ANGLES)
def test_lsd_finds_a_drawn_edge_where_it_is(angle):
    for offset in (0.0, 0.3):
        found = detect_lsd(drawn_edge(angle, offset))
        assert len(found) == 1
        assert np.hypot(*(found[0, 2:] - found[0, :2])) > 190
        np.testing.assert_allclose(offsets(found, angle), offset, atol=0.1)


def test_lsd_has_no_bias_to_one_side():
    errors = [offsets(detect_lsd(drawn_edge(a, 0.0)), a).mean() * np.cos(a) for a in ANGLES]
    assert abs(np.mean(errors)) < 0.015


@pytest.mark.parametrize("angle", ANGLES)
def test_hough_finds_a_drawn_edge_within_a_pixel(angle):
    found = detect_hough(drawn_edge(angle, 0.0))
    assert len(found) > 0
    np.testing.assert_allclose(offsets(found, angle), 0.0, atol=1.5)
    np.testing.assert_array_equal(found, detect_hough(drawn_edge(angle, 0.0)))


@pytest.mark.parametrize("detect", [detect_lsd, detect_hough])
def test_an_image_without_an_edge_has_no_segment(detect):
    found = detect(np.full((240, 320), 90, np.uint8))
    assert found.shape == (0, 4)
    assert found.dtype == np.float32


LENSES = {
    "barrel": ((-0.2, 0.05, 0.001, -0.001, 0.0), "plumb_bob"),
    "pincushion": ((0.25, 0.0, 0.0, 0.0, 0.0), "plumb_bob"),
    "rational": ((-0.2, 0.03, 0.0, 0.0, 0.0, 0.05, 0.01, 0.0), "rational_polynomial"),
    "fisheye": ((-0.02, 0.004, 0.0, 0.0), "equidistant"),
}


@pytest.mark.parametrize("name", LENSES)
def test_undistorted_images_and_undistorted_points_agree(name):
    """A dot that the lens has moved is found where its undistorted point is."""
    lens = Lens(camera_file(*LENSES[name]))
    for dot in ([60, 50], [160, 120], [250, 190]):
        image = np.zeros((240, 320), np.float32)
        image[dot[1], dot[0]] = 1
        image = cv2.GaussianBlur(image, (0, 0), 3.0)
        seen = lens.undistort(np.round(image / image.max() * 255).astype(np.uint8)).astype(float)
        rows, columns = np.indices(seen.shape)
        weight = np.where(seen > 127, seen, 0)
        centroid = [(weight * columns).sum(), (weight * rows).sum()] / weight.sum()
        np.testing.assert_allclose(lens.undistort_points(np.array([dot]))[0], centroid, atol=0.15)


def test_a_lens_without_distortion_changes_nothing():
    image = np.random.default_rng(0).integers(0, 255, (240, 320)).astype(np.uint8)
    np.testing.assert_array_equal(Lens(camera_file()).undistort(image), image)


def test_no_segment_comes_from_the_rim_of_what_the_lens_saw():
    """A pincushion lens leaves curved corners without an image, and pixels' ends are drawn out."""
    frontend = Frontend(camera_file((0.25, 0.0, 0.0, 0.0, 0.0)))
    assert not frontend.lens.seen[0, 0] and frontend.lens.seen[120, 160]
    flat = frontend.undistort(np.full((240, 320), 200, np.uint8))
    assert len(frontend.detect(flat)) == 0
    stripes = np.tile(np.repeat(np.uint8([40, 200]), 12), (240, 14))[:, :320]
    found = frontend.detect(frontend.undistort(np.ascontiguousarray(stripes)))
    assert len(found) > 5
    ends = np.rint(found.reshape(-1, 2)).astype(int)
    assert frontend.lens.seen[ends[:, 1].clip(0, 239), ends[:, 0].clip(0, 319)].all()


def test_what_a_folding_lens_shows_twice_is_not_seen():
    """Beyond the radius where the polynomial turns back, the image would come again, mirrored."""
    lens = Lens(camera_file((-0.6, 0.0, 0.0, 0.0, 0.0), f=160.0))
    radius = 160 / np.sqrt(3 * 0.6)  # r (1 - 0.6 r²) has its maximum here
    rows, columns = np.indices((240, 320))
    away = np.hypot(columns - 159.5, rows - 119.5)
    assert not lens.seen[away > radius + 1].any()
    assert lens.seen[away < radius - 10].all()


def test_packing_keeps_the_longest_and_counts_the_rest():
    lengths = [5, 30, 10, 20]
    segments = np.array([[0, y, length, y] for y, length in enumerate(lengths)], np.float32)
    packed, overflow = pack(segments, 3)
    assert overflow == 1
    assert packed.valid.all()
    np.testing.assert_allclose(packed.length, [30, 20, 10])
    packed, overflow = pack(segments, 6)
    assert overflow == 0
    np.testing.assert_array_equal(packed.valid, [True] * 4 + [False] * 2)
    np.testing.assert_array_equal(packed.endpoints[4:], 0)
    packed, overflow = pack(np.zeros((0, 4), np.float32), 2)
    assert not packed.valid.any() and overflow == 0


def test_segments_below_the_horizon_come_before_longer_ones_above(tmp_path):
    image = np.full((240, 320), 60, np.uint8)
    image[:30, 20:300] = 200  # long edges above the horizon, at row 47
    image[150:, :] = 120
    cv2.imwrite(str(tmp_path / "a.png"), image)
    frontend = Frontend(camera_file(), FrontendSettings(capacity=1))
    view = frontend.view(tmp_path / "a.png")
    assert view.readable and view.detected > 1 and view.overflow == view.detected - 1
    np.testing.assert_allclose(view.segments_image.endpoints[0, :, 1], 149.5, atol=0.1)


def test_a_detector_of_ones_own_takes_the_place_of_opencvs(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((240, 320), np.uint8))
    mine = np.array([[10, 200, 90, 210], [1, 1, 2, 2], [0, np.nan, 50, 50]])
    view = Frontend(camera_file(), detector=lambda image: mine).view(tmp_path / "a.png")
    assert view.detected == 1  # one is too short, one is no number
    np.testing.assert_array_equal(view.segments_image.endpoints[0], [[10, 200], [90, 210]])


def test_files_that_hold_no_image_read_as_none(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (240, 320)).astype(np.uint8)
    whole = cv2.imencode(".png", image)[1].tobytes()
    for name, data in (("empty", b""), ("text", b"hello"), ("cut", whole[: len(whole) // 2])):
        (tmp_path / name).write_bytes(data)
        assert read_image(tmp_path / name) is None
    assert read_image(tmp_path / "missing") is None
    assert read_image(tmp_path) is None
    (tmp_path / "whole").write_bytes(whole)
    np.testing.assert_array_equal(read_image(tmp_path / "whole"), image)


def test_an_image_of_another_size_counts_as_unreadable(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((120, 160), np.uint8))
    view = Frontend(camera_file()).view(tmp_path / "a.png")
    assert not view.readable
    assert not view.segments_image.valid.any()


@pytest.mark.parametrize("pitch, roll", [(0.26, 0.0), (-0.1, 0.2), (1.2, -0.5)])
def test_the_horizon_in_numpy_is_that_of_the_geometry(pitch, roll):
    camera = camera_file().camera
    mount = Mount.create(0.6, pitch, roll=roll, yaw=0.3)
    line = np.asarray(horizon(floor_homography(camera, mount, SE2.identity())))
    plain = horizon_image(np.asarray(camera.K), pitch, roll)
    plain, line = (l / np.linalg.norm(l) for l in (plain, line))
    np.testing.assert_allclose(plain, line, atol=1e-5)


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_an_image_of_16_bits_is_read_as_its_upper_eight_of_those_that_are_filled(tmp_path, bits):
    image = np.random.default_rng(0).integers(0, 256, (240, 320)).astype(np.uint8)
    image[0, 0] = 255
    stored = (image.astype(np.uint16) << (bits - 8)) + (1 << (bits - 8)) - 1
    cv2.imwrite(str(tmp_path / "a.png"), stored)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), image)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png", 16), image >> (16 - bits))


def test_a_small_file_that_unfolds_into_gigabytes_is_no_image(tmp_path):
    """In a process of its own: OpenCV takes the limit when it is loaded."""
    rows = b"".join(b"\0" * 20001 for _ in range(20000))
    chunk = lambda kind, data: (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    )
    header = struct.pack(">IIBBBBB", 20000, 20000, 8, 0, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows))
    (tmp_path / "bomb.png").write_bytes(png + chunk(b"IEND", b""))
    code = (
        "import resource, sys\n"
        "from sofjax.vision import read_image\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "assert read_image(sys.argv[1]) is None\n"
        "assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 100_000\n"
    )
    subprocess.run([sys.executable, "-c", code, tmp_path / "bomb.png"], check=True)


def view_of(*segments, fault=""):
    packed, overflow = pack(np.reshape(segments, (-1, 4)).astype(np.float32), 4)
    return ImageSegments(packed, overflow, len(segments), fault, {})


def test_a_view_that_repeats_the_last_one_while_the_robot_moves_tells_nothing():
    a, b, empty = view_of([0, 0, 9, 9]), view_of([0, 0, 9, 8]), view_of()
    lost = view_of(fault="cannot be read")
    moved, still = [0.05, 0, 0], [0.0, 0, 0]
    views = [a, a, a, lost, a, b, b, empty, empty, b]
    steps = [moved, still, moved, moved, moved, moved, still, moved, moved, moved]
    judged = list(without_repeats(views, np.array(steps)))
    repeats = [i for i, view in enumerate(judged) if view.fault.startswith("repeat")]
    assert repeats == [2, 4, 9]
    assert all(not judged[i].segments_image.valid.any() for i in repeats)
    assert judged[3].fault == "cannot be read" and judged[7].readable
    turning = list(without_repeats([a, a], np.array([still, [0, 0, 0.05]])))
    assert not turning[1].readable
