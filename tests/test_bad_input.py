"""What cannot be used is refused with one sentence and exit code 2, never a traceback."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from sofjax.cli import main

OFFICE = Path(__file__).parent.parent / "examples" / "office"
IMAGES = 12


@pytest.fixture
def drive(tmp_path):
    """The first images of the sample, to be spoilt."""
    drive = tmp_path / "drive"
    (drive / "rgb").mkdir(parents=True)
    for name in ("camera.yaml", "odometry.txt", "groundtruth.txt", "floor_segments.csv"):
        shutil.copy(OFFICE / name, drive / name)
    for i in range(IMAGES):
        shutil.copy(OFFICE / "rgb" / f"{i:06d}.jpg", drive / "rgb")
    lines = (OFFICE / "rgb.txt").read_text().splitlines()
    (drive / "rgb.txt").write_text("\n".join(lines[: IMAGES + 1]) + "\n")
    return drive


@pytest.fixture
def refused(tmp_path, capfd):
    """Call the command line, and give the one sentence with which it refuses."""

    def call(*args):
        assert main([str(arg) for arg in args]) == 2
        out, err = capfd.readouterr()
        assert out == ""
        assert err.startswith("sofjax: ") and err.count("\n") == 1
        assert "Traceback" not in err and "Error" not in err
        return err

    return call


def replace(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_a_drive_that_is_not_there(refused, tmp_path):
    for command in ("run", "inspect"):
        assert "no such drive" in refused(command, tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    assert "this is a file" in refused("run", tmp_path / "file")


@pytest.mark.parametrize("name", ["camera.yaml", "rgb.txt", "odometry.txt"])
def test_a_file_that_is_missing(refused, drive, name):
    (drive / name).unlink()
    assert f"{name}: " in refused("run", drive)
    assert "missing" in refused("run", drive)


@pytest.mark.parametrize(
    "name", ["camera.yaml", "rgb.txt", "odometry.txt", "groundtruth.txt", "floor_segments.csv"]
)
@pytest.mark.parametrize("content", [b"", b"\n# nothing\n", b"\xff\xfe\x00\x01\x80", b"\x00" * 50])
def test_a_file_that_is_empty_or_no_text(refused, drive, name, content):
    (drive / name).write_bytes(content)
    assert name in refused("run", drive)


@pytest.mark.parametrize("name", ["camera.yaml", "rgb.txt", "odometry.txt"])
def test_a_folder_in_the_place_of_a_file(refused, drive, name):
    (drive / name).unlink()
    (drive / name).mkdir()
    assert name in refused("run", drive)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.9])
@pytest.mark.parametrize("name", ["camera.yaml", "odometry.txt", "groundtruth.txt"])
def test_a_file_that_is_cut_off(refused, drive, name, share):
    data = (drive / name).read_bytes()
    cut = data[: int(share * len(data))]
    end = max(cut.rfind(b" "), cut.rfind(b"[") + 1)  # within a row
    (drive / name).write_bytes(cut[:end])
    assert name in refused("run", drive)


ROWS = {
    "7 columns": ("0.040 0.1 0 0 0 0 1", "line 3: 7 columns where there must be 8"),
    "9 columns": ("0.040 0.1 0 0 0 0 0 1 1", "line 3: 9 columns"),
    "nan": ("0.040 nan 0 0 0 0 0 1", "line 3: 'nan' is not a finite number"),
    "infinite": ("0.040 0 1e999 0 0 0 0 1", "line 3: '1e999' is not a finite number"),
    "a word": ("0.040 0 east 0 0 0 0 1", "line 3: 'east' is not a number"),
    "commas": ("0.040,0,0,0,0,0,0,1", "line 3: 1 columns"),
    "a stamp again": ("0.000 7 0 0 0 0 0 1", "lines 2, 3: a timestamp repeats with another value"),
    "a stamp back": ("-1.0 0 0 0 0 0 0 1", "line 3: the timestamp -1.000000 runs back"),
    "no quaternion": ("0.040 0 0 0 0 0 0 0", "line 3: the quaternion qx qy qz qw has length 0"),
    "a camera's axes": ("0.040 0 0 0 0.5 -0.5 0.5 -0.5", "x forward and z up"),
}


@pytest.mark.parametrize("name", ["odometry.txt", "groundtruth.txt"])
@pytest.mark.parametrize("fault", ROWS)
def test_a_row_that_is_no_pose(refused, drive, name, fault):
    row, sentence = ROWS[fault]
    lines = (drive / name).read_text().splitlines()
    lines[2] = row
    (drive / name).write_text("\n".join(lines))
    err = refused("run", drive)
    assert name in err and sentence in err


def test_odometry_of_one_pose(refused, drive):
    (drive / "odometry.txt").write_text("0.0 0 0 0 0 0 0 1\n")
    assert "one pose alone" in refused("run", drive)


def test_odometry_that_never_meets_the_images(refused, drive):
    (drive / "odometry.txt").write_text("100.0 0 0 0 0 0 0 1\n101.0 0 0 0 0 0 0 1\n")
    err = refused("run", drive)
    assert "never meet" in err and "100.000 to 101.000 s" in err


IMAGE_ROWS = {
    "one column": ("rgb/000001.jpg", "two columns"),
    "nan": ("nan rgb/000001.jpg", "'nan' is not a finite number"),
    "a word": ("soon rgb/000001.jpg", "'soon' is not a number"),
    "a stamp again": ("0.000 rgb/000001.jpg", "lines 2, 3: a timestamp repeats"),
    "a stamp back": ("-5 rgb/000001.jpg", "runs back"),
    "a folder above": ("0.100 ../secret.jpg", "inside the drive's folder"),
    "a way round": ("0.100 rgb/../../secret.jpg", "inside the drive's folder"),
    "from the root": ("0.100 /etc/hostname", "inside the drive's folder"),
    "a long name": ("0.100 " + "a" * 5000, "inside the drive's folder"),
    "a null": ("0.100 a\0b", "inside the drive's folder"),
}


@pytest.mark.parametrize("fault", IMAGE_ROWS)
def test_a_row_that_is_no_image(refused, drive, fault):
    row, sentence = IMAGE_ROWS[fault]
    lines = (drive / "rgb.txt").read_text().splitlines()
    lines[2] = row
    (drive / "rgb.txt").write_text("\n".join(lines))
    err = refused("run", drive)
    assert "rgb.txt, line" in err and sentence in err


def test_stamps_of_different_units(refused, drive):
    rows = [line.split() for line in (drive / "odometry.txt").read_text().splitlines()[1:]]
    counted = [" ".join([str(round(float(t) * 1e9)), *pose]) for t, *pose in rows]
    (drive / "odometry.txt").write_text("\n".join(counted))
    err = refused("run", drive)
    assert "odometry.txt: its timestamps are nanoseconds and those of rgb.txt and " in err


@pytest.mark.parametrize("kind", ["file", "folder", "ring"])
def test_an_image_that_is_a_link_out_of_the_drive(refused, drive, tmp_path, kind):
    (tmp_path / "outside").mkdir()
    shutil.copy(OFFICE / "rgb" / "000001.jpg", tmp_path / "outside" / "000001.jpg")
    link = drive / "rgb" / "000001.jpg"
    if kind == "folder":
        (drive / "away").symlink_to(tmp_path / "outside")
        replace(drive / "rgb.txt", "rgb/000001.jpg", "away/000001.jpg")
    else:
        link.unlink()
        link.symlink_to(link if kind == "ring" else tmp_path / "outside" / "000001.jpg")
    assert "rgb.txt, line 3: " in refused("run", drive)


def test_a_link_within_the_drive_is_fine(drive, tmp_path, capfd):
    link = drive / "rgb" / "000001.jpg"
    link.unlink()
    link.symlink_to(drive / "rgb" / "000002.jpg")
    assert main(["inspect", str(drive), "--out", str(tmp_path / "a.png")]) == 0


def test_most_images_missing(refused, drive):
    for i in range(2, IMAGES):
        (drive / "rgb" / f"{i:06d}.jpg").unlink()
    err = refused("run", drive)
    assert "10 of its 12 images are missing" in err and "000002.jpg" in err


@pytest.mark.parametrize("content", [b"", b"this is no image", None])
def test_no_image_that_can_be_read(refused, drive, content):
    for file in (drive / "rgb").iterdir():
        data = file.read_bytes()[:3000] if content is None else content
        file.write_bytes(data)
    assert "none of its 12 images can be read" in refused("run", drive)


def test_images_of_another_size(refused, drive):
    for file in (drive / "rgb").iterdir():
        cv2.imwrite(str(file), np.zeros((480, 640), np.uint8))
    err = refused("run", drive)
    assert "640x480" in err and "320x240" in err


CAMERA = {
    "no width": ("image_width: 320\n", "", "'image_width' is missing"),
    "a slip in a name": ("image_width", "image_widht", "did you mean 'image_widht'"),
    "half a pixel": ("320", "320.5", "'image_width'"),
    "no pixels": ("320", "0", "'image_width'"),
    "pixels without end": ("320", "999999999", "'image_width'"),
    "K of an image twice the size": (
        "270.0, 0.0, 159.5, 0.0, 270.0, 119.5",
        "540.0, 0.0, 319.5, 0.0, 540.0, 239.5",
        "principal point",
    ),
    "the image half of K's size": ("image_width: 320", "image_width: 160", "principal point"),
    "K of 8 numbers": ("0.0, 0.0, 1.0]", "0.0, 1.0]", "8 numbers and must have 9"),
    "K with a nan": ("159.5", ".nan", "must be finite"),
    "K with an infinity": ("159.5", ".inf", "must be finite"),
    "K with a word": ("159.5", "middle", "must be a number"),
    "K with nothing": ("159.5", "null", "must be a number"),
    "K with skew": ("270.0, 0.0, 159.5", "270.0, 0.5, 159.5", "must have the form"),
    "a negative focal length": ("[270.0", "[-270.0", "positive"),
    "an unknown lens": ("plumb_bob", "thin_prism", "'distortion_model' is 'thin_prism'"),
    "a lens that is a list": ("plumb_bob", "[1, 2]", "'distortion_model'"),
    "3 coefficients": ("-0.14, 0.05, 0.0003, 0.0005, 0.0", "1, 2, 3", "3 numbers and must have 4"),
    "a coefficient nan": ("-0.14", ".nan", "must be finite"),
    "coefficients of another model": ("-0.14, 0.05", "1e30, -1e30", "nothing of the image"),
    "no mount": ("mount:", "mounted:", "'mount' is missing"),
    "a mount without a height": ("height: 0.6, ", "", "'mount' must have a 'height'"),
    "a mount with a slip": ("height: 0.6", "heigth: 0.6", "did you mean 'height'"),
    "a mount that is a number": ("{x: 0.05, y: 0.0, height: 0.6, pitch: 0.2618, roll: 0.0, "
        "yaw: 0.0}", "0.6", "'name: value' pairs"),
    "a height of zero": ("height: 0.6", "height: 0", "greater than 0"),
    "a height below the floor": ("height: 0.6", "height: -0.6", "greater than 0"),
    "a height in millimetres": ("height: 0.6", "height: 600", "metres"),
    "a height nan": ("height: 0.6", "height: .nan", "must be finite"),
    "a height that is true": ("height: 0.6", "height: true", "must be a number"),
    "a pitch in degrees": ("0.2618", "15", "radians"),
    "a roll in degrees": ("roll: 0.0", "roll: 90", "a full turn, 6.2832, either way"),
    "a pitch to the ceiling": ("0.2618", "-0.8", "above the horizon"),
    "a name twice": ("image_height", "image_width", "twice"),
    "YAML that runs code": ("office", "!!python/object/apply:os.system ['false']", "not plain"),
    "YAML with an alias": ("320", "&a [1]\nother: *a", "aliases"),
    "minutes and seconds": ("320", "5:20", "'image_width' is '5:20'"),
    "an octal number": ("320", "0500", "'image_width' is '0500'"),
    "YAML with a tag": ("320", "!!int 320", "tag 'tag:yaml.org,2002:int' is not allowed"),
    "YAML that is not": ("320", "[", "not plain YAML"),
    "YAML that is deep": ("320", "[" * 3000, "nested too deep"),
}  # fmt: skip


@pytest.mark.parametrize("fault", CAMERA)
def test_a_camera_that_cannot_be(refused, drive, fault):
    old, new, sentence = CAMERA[fault]
    replace(drive / "camera.yaml", old, new)
    err = refused("run", drive)
    assert ("camera.yaml" in err or "camera 'office'" in err) and sentence in err


def test_yaml_that_unfolds_without_end(refused, drive):
    rows = ["a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    rows += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
    (drive / "camera.yaml").write_text("\n".join(rows))
    assert "aliases" in refused("run", drive)


def test_yaml_that_is_huge(refused, drive):
    (drive / "camera.yaml").write_text("# " + "x" * 2_000_000)
    assert "bytes are too many" in refused("run", drive)


def test_a_true_segment_of_a_thousand_kilometres(refused, drive):
    with open(drive / "floor_segments.csv", "a") as file:
        file.write("0,0,1e9,0,wall\n")
    assert "line 51: a segment of 1e+09 m; it must be in metres" in refused("run", drive)


@pytest.mark.parametrize("word", ["1_0", "١", "0x10", "1e", "--1", "1e30", "infinity"])
def test_a_number_is_a_plain_decimal(refused, drive, word):
    replace(drive / "odometry.txt", "0.00023", word)
    assert "odometry.txt, line 3: " in refused("run", drive)


@pytest.mark.parametrize("row", ["1,2,3", "1,2,3,nan,wall", "1,2,3,east,wall", "1 2 3 4"])
def test_true_segments_that_are_none(refused, drive, row):
    (drive / "floor_segments.csv").write_text(f"# header\n{row}\n")
    assert "floor_segments.csv, line 2: " in refused("run", drive)
