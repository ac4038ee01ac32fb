"""`sofjax calibrate robot`: what a drive tells of a rig, what it does not, and what is kept."""

import dataclasses
import json
import re
from functools import cache

import driven
import jax
import numpy as np
import pytest
import yaml
from test_calibrate_mount import OFFICE, make_drive

import sofjax.pipeline.calibrate as calibrate
from sofjax.calibration import MOUNT, TURNS, UNKNOWNS, DriveFitConfig, fit_drive
from sofjax.calibration.assessment import accuracy, grade, too_wide
from sofjax.calibration.fit_drive import CONTRADICTED, contradicted
from sofjax.cli import main, summaries
from sofjax.cli.calibrate_robot import free_names
from sofjax.io.camera_file import read_camera
from sofjax.io.drive import read_drive
from sofjax.pipeline.calibrate import BY_DEFAULT, IF_TOLD
from sofjax.pipeline.outcomes import FREE, OF_MOUNT, OF_RIG
from sofjax.rig import RIG

CONFIG = DriveFitConfig(more=IF_TOLD, starts=((1.0, 0.0),), capacity=512)
DEGREE = np.pi / 180


@cache
def log_of(**by):
    with jax.enable_x64(True):
        return driven.drive(**by)


def fitted(**by):
    """A drive by a rig that is other than it was given, fitted from what was given."""
    return fit_drive(driven.given_rig(), log_of(**by), CONFIG)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(
    ("name", "by", "within"),
    [
        ("focal", np.log(1.04), 0.004),
        ("k1", 0.03, 0.005),
        ("time_offset", 0.08, 0.002),
        ("x", 0.3, 0.02),  # heights of the camera
        ("y", 0.2, 0.01),
        ("pitch", DEGREE, 0.05 * DEGREE),
        ("roll", DEGREE, 0.05 * DEGREE),
        ("yaw", DEGREE, 0.2 * DEGREE),
        ("height", 0.1, 0.005),
    ],
)
def test_what_is_wrong_is_found_and_all_else_stays_as_it_was_given(name, by, within):
    found = fitted(**{name: by})
    assert found.verdict(CONFIG).usable
    changed = dict(zip(UNKNOWNS, np.asarray(found.estimate.by).tolist(), strict=True))
    assert changed[name] == pytest.approx(by, abs=within)
    assert {k for k in RIG if changed[k]} == {name}
    sigma = np.sqrt(np.diag(found.covariance))[UNKNOWNS.index(name)]
    assert 0 < sigma < within and abs(changed[name] - by) < 5 * sigma
    assert name not in found.as_given and name not in found.not_told


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_a_steady_straight_drive_does_not_tell_the_clock():
    """Though the images are 80 ms late: it stays as it was given, and is named."""
    found = fitted(turns=False, time_offset=0.08)
    assert not np.asarray(found.estimate.by)[: len(RIG)].any()
    assert "time_offset" in found.not_told and {"x", "y"} <= set(found.not_told)
    assert {"height", "pitch", "roll"} <= set(found.as_given)
    told = fitted()
    assert "time_offset" in told.as_given
    assert not np.asarray(told.estimate.by)[: len(RIG)].any()
    assert {*told.as_given, *told.not_told} == set(RIG) - {"line_delay"}
    assert np.abs(told.estimate.bias).max() < 0.005  # its odometer has no error


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_what_a_fit_of_a_few_numbers_does_not_need_is_set_back():
    """By a wide covariance of many numbers one may seem contradicted: it is asked again."""
    found = fitted(height=0.03)  # so much an odometer may err: the height holds
    assert not np.asarray(found.estimate.by)[: len(RIG)].any()
    assert float(found.estimate.bias[0]) == pytest.approx(np.exp(-0.03) - 1, abs=0.003)
    assert "height" in found.as_given


# What is contradicted


def belief(sigma, correlation=0.0):
    """A covariance of height, pitch and focal, the last two correlated."""
    at = [UNKNOWNS.index(name) for name in ("height", "pitch", "focal")]
    C = np.diag(np.square(sigma)).astype(float)
    C[1, 2] = C[2, 1] = correlation * sigma[1] * sigma[2]
    whole = np.zeros((len(UNKNOWNS),) * 2)
    whole[np.ix_(at, at)] = C
    return whole


def step_of(**by):
    return np.array([by.get(name, 0.0) for name in UNKNOWNS])


THREE = ("height", "pitch", "focal")


def test_what_is_many_standard_deviations_off_is_contradicted():
    by = step_of(height=0.05, pitch=0.001, focal=0.1)
    step, kept = contradicted(by, belief([0.01, 0.001, 0.02]), THREE)
    assert kept == {"height", "focal"} and CONTRADICTED == 4
    np.testing.assert_allclose(step, step_of(height=0.05, focal=0.1))


def test_one_of_two_that_explain_the_same_is_set_back_and_the_other_stands_for_it():
    """By hand. Given that the focal length is right, the pitch is s_p/s_f r · 0.03 less, and known
    to sqrt(1 - r²) of what it was: 0.019 - 0.9 · 0.01/0.02 · 0.03 = 0.0055 and 0.00436, 1.3 of it.
    """
    by = step_of(pitch=0.019, focal=0.03)
    step, kept = contradicted(by, belief([0.01, 0.01, 0.02], 0.9), THREE)
    assert not kept
    np.testing.assert_allclose(step, 0, atol=1e-12)
    # the same with smaller errors: the focal length goes first, and then the pitch is clear
    step, kept = contradicted(by, belief([0.01, 0.003, 0.02], 0.9), THREE)
    assert kept == {"pitch"}
    assert step[1] == pytest.approx(0.019 - 0.9 * 0.003 / 0.02 * 0.03)
    assert step[UNKNOWNS.index("focal")] == 0


def test_an_odometer_s_errors_were_not_given_and_stay():
    i = UNKNOWNS.index("left")
    S = belief([0.01, 0.001, 0.02])
    S[i, i] = 0.01**2
    step, kept = contradicted(step_of(left=0.001), S, (*THREE, "left"))
    assert not kept and step[i] == pytest.approx(0.001)


# The command


class Recorded:
    """A simulated drive in the place of the images of a folder."""

    def __init__(self, monkeypatch, tmp_path):
        self.folder = make_drive(tmp_path / "drive", 40)
        self.out = tmp_path / "found.yaml"
        self._patch = monkeypatch
        config = calibrate._config

        def small(*args):
            return dataclasses.replace(config(*args), starts=CONFIG.starts, capacity=512)

        monkeypatch.setattr(calibrate, "_config", small)

    def by(self, text="", **by):
        """The drive was made by a rig that is other than its file says; `text` joins the file."""
        log = jax.tree.map(np.asarray, log_of(**by))
        rig = driven.given_rig()
        K = ", ".join(map(str, np.asarray(rig.camera.K).ravel()))
        (self.folder / "camera.yaml").write_text(
            f"image_width: 320\nimage_height: 240\ncamera_name: webcam\n"
            f"camera_matrix: {{rows: 3, cols: 3, data: [{K}]}}\ndistortion_model: plumb_bob\n"
            "distortion_coefficients:\n  data: [-0.14, 0.05, 0.0003, 0.0005, 0.0]\n"
            f"mount: {{x: 0.05, y: 0.0, height: 0.6, pitch: 0.26, roll: 0.0, yaw: 0.0}}\n{text}"
        )
        self._patch.setattr(calibrate, "observe_drive", lambda *args: log)
        return read_camera(self.folder / "camera.yaml")

    def calibrate(self, *args, what="robot"):
        return main(["calibrate", what, str(self.folder), "-o", str(self.out), *args])


@pytest.fixture
def recorded(monkeypatch, tmp_path):
    return Recorded(monkeypatch, tmp_path)


@pytest.mark.slow
def test_with_everything_right_the_file_s_numbers_come_back(recorded, capfd):
    before = recorded.by("time_offset: 0.0\nline_delay: 1.1e-05\n")
    assert recorded.calibrate() == 0
    after = read_camera(recorded.out)
    for a, b in zip(*(jax.tree.leaves((f.camera, f.mount)) for f in (before, after)), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(after.distortion, before.distortion)
    assert after.rig_fields.time_offset == 0 and after.rig_fields.line_delay == 1.1e-5
    assert after.rig_fields.sigma["height"] < 0.01 and after.rig_fields.sigma["pitch"] < 0.005
    said = capfd.readouterr().out
    (line,) = re.findall("as given  (.*)", said)
    assert "focal" in line and "nothing contradicts" in line
    assert "verdict   good: known height to" in said
    next_line = f"next: cp {recorded.out} {recorded.folder}/camera.yaml, then sofjax run "
    assert said.rstrip().endswith(next_line + str(recorded.folder))


@pytest.mark.slow
def test_a_clock_that_is_late_is_written_and_the_drive_reads_it(recorded, capfd):
    recorded.by(time_offset=-0.08)
    assert recorded.calibrate() == 0
    fields = yaml.safe_load(recorded.out.read_text())
    assert float(fields["time_offset"]) == pytest.approx(-0.08, abs=0.002)
    assert fields["sigma"]["time_offset"] < 0.002 and set(fields["odometer"]) == set(UNKNOWNS[-4:])
    assert re.search(r"time_offset -(79|80)\.\d ± 0\.\d ms", capfd.readouterr().out)
    (recorded.folder / "camera.yaml").write_text(recorded.out.read_text())
    drive = read_drive(recorded.folder)
    np.testing.assert_allclose(
        drive.odometer_stamps - drive.image_stamps, float(fields["time_offset"])
    )
    run = recorded.out.parent / "run"
    command = ["run", str(recorded.folder), "--particles", "20", "--loop", "none"]
    assert main([*command, "--out", str(run)]) == 0
    settings = json.loads((run / "report.json").read_text())["settings"]
    assert settings["motion.left_error"] == pytest.approx(fields["odometer"]["left"])
    assert f"next: sofjax evaluate {run}" in capfd.readouterr().out


@pytest.mark.slow
def test_free_says_what_is_fitted_and_mount_writes_the_mount_alone(recorded, capfd):
    recorded.by(focal=np.log(1.04))
    assert recorded.calibrate("--free", "focal") == 0
    assert "verdict   good: known focal length to" in capfd.readouterr().out
    assert float(read_camera(recorded.out).camera.K[0, 0]) == pytest.approx(270 * 1.04, rel=0.004)
    assert recorded.calibrate(what="mount") in (0, 3)
    recorded.by(height=0.1)
    assert recorded.calibrate(what="mount") == 0
    fields = yaml.safe_load(recorded.out.read_text())
    assert not {"odometer", "sigma", "time_offset", "line_delay"} & set(fields)
    assert fields["mount"]["height"] == pytest.approx(0.6 * np.exp(0.1), rel=0.01)
    assert fields["camera_matrix"]["data"][0] == 270.0 and fields["mount"]["x"] == 0.05


@pytest.mark.slow
def test_a_drive_without_lines_is_not_usable(tmp_path, capfd):
    drive, out = make_drive(tmp_path / "drive", 12), tmp_path / "camera.yaml"
    assert main(["calibrate", "robot", str(drive), "-o", str(out)]) == 3
    said = capfd.readouterr().out
    assert "not usable" in said and "is not written" in said and "next:" not in said
    assert not out.exists()


def test_names_to_free(capfd, tmp_path):
    assert (OF_RIG, OF_MOUNT) == (RIG, (*MOUNT, *UNKNOWNS[-4:])) and FREE == UNKNOWNS
    assert free_names("focal,time_offset", robot=True) == ("focal", "time_offset")
    assert set(BY_DEFAULT) | set(IF_TOLD) == set(RIG) - {"line_delay"}
    for what, free, words in (
        ("robot", "focus", "there is no 'focus'; did you mean 'focal'"),
        ("robot", "left", "at least must be free"),
        ("mount", "focal", "there is no 'focal'"),
    ):
        out = str(tmp_path / "camera.yaml")
        assert main(["calibrate", what, str(OFFICE), "--free", free, "-o", out]) == 2
        said = capfd.readouterr().err
        assert said.startswith("sofjax: --free: ") and words in said


def test_what_is_known_is_told_of_the_mount_or_of_what_was_fitted():
    C = np.zeros((len(UNKNOWNS),) * 2)
    C[0, 0], C[1, 1] = 0.01**2, (0.1 * DEGREE) ** 2
    assert accuracy(C) == "known height to 1 %, pitch to 0.1°, apart from the odometer's scale"
    C = np.zeros_like(C)
    i = UNKNOWNS.index("time_offset")
    C[i, i] = 0.002**2
    assert accuracy(C).startswith("known time offset to 2 ms")
    assert TURNS == UNKNOWNS[-3:]


def test_the_next_command_is_one_to_type(tmp_path):
    drive, out = tmp_path / "my drive", tmp_path / "f.yaml"
    assert summaries.next_command("run") == "next: sofjax run DRIVE"
    assert summaries.next_command("run", drive) == f"next: sofjax run '{drive}'"
    said = summaries.next_command("run", drive, put=out)
    assert said == f"next: cp {out} '{drive}'/camera.yaml, then sofjax run '{drive}'"
    assert summaries.next_command("run", drive, put=drive / "camera.yaml").count("cp ") == 0


def test_a_mount_that_is_known_too_little_is_refused_with_what_to_drive():
    C = np.diag([0.14**2, np.radians(3.9) ** 2, 1e-8, *[0.0] * (len(UNKNOWNS) - 3)])
    assert grade(C) == "not usable"
    said = too_wide(C, "").sentence
    assert "the height (known to 14 %) and the pitch (known to 3.9°)" in said
    assert "drive some metres" in said and "roll (" not in said
    assert too_wide(C, "the clock is late").sentence.endswith("the clock is late")
