"""The examples run as they stand, on the first images of the sample."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import QUICK
from test_cli import make_drive

EXAMPLES = Path(__file__).parent.parent / "examples"
SAID = {
    "quickstart": "m from the true path",
    "batch_likelihood": "best of 10,000 poses (x, y, yaw): 0.5",
    "learn_noise": "log-evidence",
    "online": "lines in the map",
}


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return make_drive(tmp_path_factory.mktemp("drives") / "short", 12)


def output(name, *args):
    strict = ["-W", "error", "-W", "ignore:Error reading persistent compilation cache entry"]
    command = [sys.executable, *strict, EXAMPLES / f"{name}.py", *args]
    environment = {**os.environ, "PYTHONPATH": str(EXAMPLES.parent)}
    environment |= QUICK if name == "learn_noise" else {}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_example_is_short_and_tested():
    files = sorted(EXAMPLES.glob("*.py"))
    assert [file.stem for file in files] == sorted(SAID)
    assert all(len(file.read_text().splitlines()) < 50 for file in files)


# the first is what the README's code does, which is tested as well
MARKED = [pytest.param(name, marks=[pytest.mark.slow] * (name == "quickstart")) for name in SAID]


@pytest.mark.parametrize("name", MARKED)
def test_an_example_runs(name, drive):
    assert SAID[name] in output(name, *([] if name == "batch_likelihood" else [drive]))
