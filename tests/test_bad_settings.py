"""Settings, options and folders that cannot be are refused in a sentence."""

import json
import shutil

import pytest
from test_bad_input import drive as drive
from test_bad_input import refused as refused

from sofjax.cli import main

SETTINGS = {
    "an unknown one": ("motion.distance_nois=1", "did you mean 'motion.distance_noise'"),
    "a section": ("motion=1", "there is no setting 'motion'"),
    "no value": ("motion.distance_noise", "the form name=value"),
    "no name": ("=1", "the form name=value"),
    "an empty value": ("motion.distance_noise=", "finite number"),
    "a word": ("motion.distance_noise=much", "finite number"),
    "nan": ("motion.distance_noise=nan", "finite number"),
    "a negative one": ("motion.distance_noise=-1", "must not be negative"),
    "digits with a line": ("filter.particles=1_0", "a whole number"),
    "digits of another script": ("motion.distance_noise=١", "finite number"),
    "half a particle": ("filter.particles=1.5", "a whole number"),
    "no particle": ("filter.particles=0", "from 1 to"),
    "particles without end": ("filter.particles=1000000000", "from 1 to"),
    "no room": ("frontend.capacity=0", "from 1 to"),
    "no room in the map": ("segment_map.capacity=0", "from 8 to"),
    "an unknown detector": ("frontend.detector=sobel", "lsd or hough"),
    "an unknown choice": ("filter.choice=best", "winner"),
    "an unknown preset": ("preset=papre", "did you mean 'paper'"),
}


@pytest.mark.parametrize("fault", SETTINGS)
def test_a_setting_that_cannot_be(refused, drive, fault):
    pair, sentence = SETTINGS[fault]
    err = refused("run", drive, "--set", pair)
    assert "--set: " in err and sentence in err


TOML = {
    "an unknown one": ("[motion]\ndistance_nois = 1", "did you mean 'motion.distance_noise'"),
    "text": ('[motion]\ndistance_noise = "much"', "finite number"),
    "true": ("[filter]\nparticles = true", "a whole number"),
    "thousands of digits": ("seed = 0x" + "f" * 5000, "from 0 to"),
    "a list": ("[filter]\nparticles = [1]", "a whole number"),
    "no particle": ("[filter]\nparticles = 0", "from 1 to"),
    "not TOML": ("[filter", "not TOML"),
    "a name twice": ("seed = 1\nseed = 2", "not TOML"),
    "no text": ("\x00", "not TOML"),
    "a preset that is a list": ("preset = [1]", "no preset [1]"),
    "a preset of many digits": ("preset = 0x" + "f" * 5000, "no preset too long"),
    "a preset that is a number": ("preset = 3", "no preset 3"),
}


@pytest.mark.parametrize("fault", TOML)
def test_a_settings_file_that_cannot_be(refused, drive, tmp_path, fault):
    text, sentence = TOML[fault]
    (tmp_path / "c.toml").write_text(text)
    err = refused("run", drive, "--config", tmp_path / "c.toml")
    assert "c.toml: " in err and sentence in err


def test_a_settings_file_that_is_missing(refused, drive, tmp_path):
    assert "c.toml: " in refused("run", drive, "--config", tmp_path / "c.toml")


def test_options_that_cannot_be(refused, drive):
    assert "--particles: " in refused("run", drive, "--particles", 0)
    assert "--particles: " in refused("run", drive, "--particles", -5)
    assert "--seed: " in refused("run", drive, "--seed", -1)
    assert "--seed: " in refused("run", drive, "--seed", 2**40)


@pytest.mark.parametrize(
    "args",
    [
        [],
        ["fly"],
        ["run"],
        ["run", "a", "--particles", "many"],
        ["run", "a", "--detector", "sobel"],
        ["run", "a", "--unknown"],
        ["run", "--set", "a=1"],
        ["evaluate"],
        ["inspect"],
    ],
)
def test_words_that_are_no_command(args, capfd):
    assert main(args) == 2
    assert "usage: sofjax" in capfd.readouterr().err


def test_a_folder_that_cannot_be_written(refused, drive, tmp_path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        err = refused("run", drive, "--out", out)
        assert "cannot be written" in err and "--out" in err
    err = refused("run", drive, "--out", "/proc/nothing")
    assert "cannot be written" in err


def test_a_run_that_cannot_be_evaluated(refused, drive, tmp_path):
    assert "no such folder" in refused("evaluate", tmp_path / "nothing", drive)
    folder = tmp_path / "run"
    folder.mkdir()
    assert "trajectory.txt" in refused("evaluate", folder, drive)
    assert "name the drive" in refused("evaluate", folder)
    (folder / "report.json").write_text("[]")
    assert "names no drive" in refused("evaluate", folder)
    (folder / "report.json").write_text('{"drive": "/nowhere/at/all"}')
    assert "no such drive" in refused("evaluate", folder)
    shutil.copy(drive / "groundtruth.txt", folder / "trajectory.txt")
    for text in ("", "[]", "{", '{"features": [{"geometry": {"type": "LineString"}}]}',
                 '{"features": [{"geometry": {"type": "LineString", "coordinates": [[0, NaN], '
                 '[1, 1]]}}]}', '{"features": 3}', "[" * 100_000):  # fmt: skip
        (folder / "map.geojson").write_text(text)
        assert "map.geojson" in refused("evaluate", folder, drive)
    line = {"type": "LineString", "coordinates": [[0, 0], [1, 0]]}
    for seen in (10**25, -1, 1.5, True, "many", None):
        features = [{"geometry": line, "properties": {"seen": seen}}]
        (folder / "map.geojson").write_text(json.dumps({"features": features}))
        assert "map.geojson, feature 1: 'seen' is " in refused("evaluate", folder, drive)
    line["coordinates"][1] = [1e9, 0]
    (folder / "map.geojson").write_text(json.dumps({"features": [{"geometry": line}]}))
    assert "map.geojson, feature 1: a segment of 1e+09 m" in refused("evaluate", folder, drive)
    (folder / "map.geojson").unlink()
    (folder / "trajectory.txt").write_text("500 0 0 0 0 0 0 1\n501 0 0 0 0 0 0 1\n")
    assert "must share" in refused("evaluate", folder, drive)
    (drive / "groundtruth.txt").unlink()
    assert "groundtruth.txt" in refused("evaluate", folder, drive)
