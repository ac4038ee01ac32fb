"""Whatever a file holds, a reader gives its content or one sentence: never another exception.

A fixed number of examples, the same at every run.
"""

import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sofjax.cli.arguments import make_parser
from sofjax.cli.run import settings_of
from sofjax.io.camera_file import mount_fields, read_camera
from sofjax.io.drive import read_drive
from sofjax.io.errors import InputError
from sofjax.io.map_file import read_map
from sofjax.io.trajectory import read_trajectory
from sofjax.io.yaml_text import parse_yaml

OFFICE = Path(__file__).parent.parent / "examples" / "office"
ROWS = 6  # of each table

MAP = (
    '{"type": "FeatureCollection", "features": [\n'
    '{"type": "Feature", "properties": {"seen": 12, "height": 0.01},\n'
    '"geometry": {"type": "LineString", "coordinates": [[0.1, 2.0], [3.0, -4.5]]}}]}\n'
)
TOML = (
    'seed = 3\npreset = "paper"\nloop = "none"\n[motion]\ndistance_noise = 0.01\n'
    "[filter]\nsoft = false\n"
)
KALIBR = (
    "cam0:\n  camera_model: pinhole\n  intrinsics: [270.0, 270.0, 159.5, 119.5]\n"
    "  distortion_model: radtan\n  distortion_coeffs: [-0.1, 0.05, 0.0, 0.0]\n"
    "  resolution: [320, 240]\nmount: {height: 0.6, pitch: 0.26}\n"
)
ODD = (
    *("nan", "-inf", "1e999", "1e308", "-0", "1_0", "0x1", "١٢", "９", "1:2", "~", "null", "true"),
    *("9" * 400, "-1", "0", "1e-400", "\0", "\r", "\r\n", "\n", "\t", "#", "---\n", "&a ", "*a"),
    *("!!int ", "{", "}", "[", "]", ":", ", ", '"', "'", "\ufeff", "\x85", "\u2028", "..", "/"),
    *("\\", "%YAML:1.0\n", "<<: ", "? ", "- ", "=", "[[", "a.b", "mount", "data", "cam1:", "é"),
)


def head(name):
    lines = (OFFICE / name).read_text().splitlines(keepends=True)
    return "".join(lines[:ROWS])


def spoilt(*texts):
    """A valid file, cut and with odd words put in and in the place of others; or any bytes."""

    @st.composite
    def draw(draw):
        text = draw(st.sampled_from(texts))
        for _ in range(draw(st.integers(1, 4))):
            begin = draw(st.integers(0, len(text)))
            end = draw(st.integers(begin, min(len(text), begin + 12)))
            word = draw(st.sampled_from(ODD) | st.text(max_size=4))
            text = text[:begin] + word + text[end:]
        end = draw(st.integers(0, len(text)) | st.just(len(text)))
        return text[:end].encode("utf-8", "surrogatepass")

    return draw() | st.binary(max_size=60)


def budget(examples):
    return settings(
        max_examples=examples,
        derandomize=True,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )


@pytest.fixture(scope="module")
def folder():
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def refuses_in_a_sentence(read, *args):
    try:
        read(*args)
    except InputError as error:
        sentence = str(error)
        assert len(sentence) < 600 and sentence.isprintable(), sentence


@budget(300)
@given(data=spoilt(head("camera.yaml"), (OFFICE / "camera.yaml").read_text(), KALIBR))
def test_a_camera_file(folder, data):
    (folder / "camera.yaml").write_bytes(data)
    refuses_in_a_sentence(read_camera, folder / "camera.yaml")


@budget(300)
@given(data=spoilt(head("odometry.txt")))
def test_a_trajectory(folder, data):
    (folder / "t.txt").write_bytes(data)
    refuses_in_a_sentence(read_trajectory, folder / "t.txt")


@pytest.mark.parametrize(
    "name", ["rgb.txt", "odometry.txt", "groundtruth.txt", "floor_segments.csv"]
)
def test_a_drive(folder, name):
    drive = folder / f"drive-{name}"
    (drive / "rgb").mkdir(parents=True)
    for file in ("camera.yaml", "rgb.txt", "odometry.txt", "groundtruth.txt", "floor_segments.csv"):
        (drive / file).write_text((OFFICE / file).read_text() if file[0] == "c" else head(file))
    for i in range(ROWS):
        shutil.copy(OFFICE / "rgb" / f"{i:06d}.jpg", drive / "rgb")

    @budget(100)
    @given(data=spoilt(head(name)))
    def spoil(data):
        (drive / name).write_bytes(data)
        refuses_in_a_sentence(read_drive, drive)

    spoil()


@budget(300)
@given(data=spoilt(MAP))
def test_a_map(folder, data):
    (folder / "map.geojson").write_bytes(data)
    refuses_in_a_sentence(read_map, folder / "map.geojson")


@budget(300)
@given(data=spoilt(TOML))
def test_a_settings_file(folder, data):
    (folder / "c.toml").write_bytes(data)
    args = make_parser().parse_args(["run", "drive", "--config", str(folder / "c.toml")])
    refuses_in_a_sentence(settings_of, args)


@budget(300)
@given(text=spoilt("height=0.6,pitch=0.26").map(lambda data: data.decode("utf-8", "replace")))
def test_a_mount_as_an_option(text):
    refuses_in_a_sentence(mount_fields, "--mount", text)


@budget(300)
@given(text=st.text(max_size=40) | st.lists(st.sampled_from(ODD)).map("".join))
def test_yaml(text):
    refuses_in_a_sentence(parse_yaml, text, "file")
