"""Boards, images and mounts that cannot be are refused in a sentence."""

import cv2
import numpy as np
import pytest
from test_calibrate_camera import ARGS, HEIGHT, WIDTH, write
from test_calibrate_camera import boards as boards
from test_calibrate_camera import rays as rays

from sofjax.cli import arguments, main
from sofjax.io.camera_file import mount_fields
from sofjax.vision.boards import PATTERNS


@pytest.fixture
def refused(boards, tmp_path, capfd):
    """The sentence with which the command refuses."""

    def call(*args, images=boards):
        out = ["-o", str(tmp_path / "camera.yaml")] if "-o" not in args else []
        images = [str(path) for path in images] if isinstance(images, list) else [str(images)]
        assert main(["calibrate", "camera", *images, *map(str, args), *out]) == 2
        _, err = capfd.readouterr()
        assert "Traceback" not in err and err.startswith("sofjax: ") and err.count("\n") == 1
        return err

    return call


@pytest.mark.parametrize(
    "board, sentence",
    [
        ("6", "inner corners along and across, like 9x6"),
        ("9x", "like 9x6"),
        ("9x6x3", "like 9x6"),
        ("-9x6", "like 9x6"),
        ("9.0x6", "like 9x6"),
        ("2x6", "from 3 to 60"),
        ("900x6", "from 3 to 60"),
        ("10x7", "with --board 9x6 they are found"),
        ("4x13", "whole board must be in view"),
    ],
)
def test_a_board_that_is_none(refused, boards, board, sentence):
    two = [boards / "00.png", boards / "01.png"]
    assert sentence in refused(f"--board={board}", "--square", 0.03, images=two)


@pytest.mark.parametrize(
    "args, sentence",
    [
        (["--pattern", "charuco"], "--marker is missing; it must be the side"),
        (["--pattern", "charuco", "--marker", "0.03"], "less than --square"),
        (["--pattern", "charuco", "--marker", "nan"], "less than --square"),
        (["--marker", "0.02"], "goes with --pattern charuco alone"),
        (["--pattern", "circles"], "--board counts circles along and across"),
        (["--pattern", "charuco", "--marker", "0.02"], "--board counts squares"),
    ],
)
def test_a_pattern_that_is_not_there(refused, boards, args, sentence):
    two = [boards / "00.png", boards / "01.png"]
    assert sentence in refused(*ARGS, *args, images=two)


def test_the_command_offers_every_pattern():
    assert arguments.PATTERNS == PATTERNS


@pytest.mark.parametrize("square", ["0", "-0.03", "nan", "inf", "30"])
def test_a_square_that_is_none(refused, square):
    assert "in metres" in refused("--board", "9x6", f"--square={square}")


@pytest.mark.parametrize(
    "mount, sentence",
    [
        ("height", "must have the form height=0.6"),
        ("", "must have the form"),
        ("hight=0.6", "did you mean 'height'"),
        ("height=-1", "greater than 0"),
        ("height=nan", "finite"),
        ("height=low", "must be a number"),
        ("pitch=15", "radians"),
        ("x=1,x=2", "given twice"),
        ("height=0.6,pitch=-1.2", "above the horizon"),
    ],
)
def test_a_mount_that_cannot_be(refused, mount, sentence, tmp_path):
    assert sentence in refused(*ARGS, "--mount", mount)
    assert not (tmp_path / "camera.yaml").exists()


def test_a_part_of_a_mount():
    assert mount_fields("--mount", "height = 0.6, yaw=-0.1") == {"height": 0.6, "yaw": -0.1}


def test_images_that_are_none(refused, tmp_path):
    assert "no such file or folder" in refused(*ARGS, images=tmp_path / "nowhere")
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "notes.txt").write_text("no image")
    assert "no image there" in refused(*ARGS, images=empty)
    assert "no image there" in refused(*ARGS, images=empty / "notes.txt")
    (empty / "broken.png").write_bytes(b"no image")
    assert "none of the 1 images can be read" in refused(*ARGS, images=empty)
    blank = write(tmp_path / "blank", [np.full((HEIGHT, WIDTH), 90, np.uint8)] * 6)
    assert "found in 0 of 6 images, and 5 are needed" in refused(*ARGS, images=blank)


def test_images_of_another_size_than_most_are_left_out(boards, tmp_path, capfd):
    large = cv2.resize(cv2.imread(str(boards / "00.png")), (640, 480))
    cv2.imwrite(str(tmp_path / "a.png"), large)
    some = [str(boards / f"{i:02d}.png") for i in range(7)]
    args = ["calibrate", "camera", str(tmp_path / "a.png"), *some, *ARGS]
    assert main([*args, "-o", str(tmp_path / "c.yaml")]) == 0
    out = capfd.readouterr().out
    assert "7 of 8 images of 320x240 used" in out
    assert "left out: has 640x480 pixels and most have 320x240" in out


def test_images_of_two_sizes_of_which_neither_is_that_of_most(refused, boards, tmp_path):
    large = cv2.resize(cv2.imread(str(boards / "00.png")), (640, 480))
    cv2.imwrite(str(tmp_path / "large.png"), large)
    sentence = refused(*ARGS, images=[boards / "00.png", tmp_path / "large.png"])
    assert "as many images have 320x240 pixels as 640x480; give those of one size" in sentence


def test_too_few_views(refused, boards):
    some = [boards / f"{i:02d}.png" for i in range(3)]
    assert "found in 3 of 3 images, and 5 are needed" in refused(*ARGS, images=some)


def test_an_output_that_cannot_be_written(refused, tmp_path):
    assert "is a folder" in refused(*ARGS, "-o", tmp_path)
    (tmp_path / "file").write_text("")
    assert "cannot be written" in refused(*ARGS, "-o", tmp_path / "file" / "camera.yaml")


def test_an_output_that_is_another_file(refused, tmp_path):
    notes = tmp_path / "notes.txt"
    notes.write_text("my notes")
    assert "no camera file that sofjax has written" in refused(*ARGS, "-o", notes)
    assert notes.read_text() == "my notes"


def test_an_image_that_cannot_be_read_is_left_out(boards, tmp_path, capfd):
    broken = tmp_path / "broken.jpg"
    broken.write_bytes(b"")
    images = [str(path) for path in sorted(boards.iterdir())[:9]]
    args = ["calibrate", "camera", *images, str(broken), *ARGS, "-o", str(tmp_path / "c.yaml")]
    assert main(args) == 0
    assert "broken.jpg           left out: cannot be read as an image" in capfd.readouterr().out
