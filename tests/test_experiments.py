"""The studies run: each by the one command, quick."""

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

EXPERIMENTS = Path(__file__).parent.parent / "experiments"
STUDIES = runpy.run_path(str(EXPERIMENTS / "run.py"))["studies"]()


def run(*arguments, **options):
    command = [sys.executable, str(EXPERIMENTS / "run.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, **options)


@pytest.mark.parametrize("script", STUDIES.values(), ids=STUDIES)
def test_every_study_has_the_common_options_and_a_page(script, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    monkeypatch.setattr(sys, "path", [str(script.parent), *sys.path])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    said = capsys.readouterr().out
    assert ended.value.code == 0
    assert all(option in said for option in ("--quick", "--seed", "--out")), said
    assert (script.parent / "README.md").is_file()


@pytest.mark.slow
def test_the_one_command_runs_what_is_named(tmp_path):
    done = run("--quick", "benchmark_likelihood", "--out", tmp_path)
    assert done.returncode == 0, done.stdout
    assert "1 of 1 passed" in done.stdout
    made = json.loads((tmp_path / "benchmark_likelihood" / "benchmark_likelihood.json").read_text())
    assert made["made"]["options"]["quick"] is True and made["problems"]
    assert (tmp_path / "benchmark_likelihood" / "benchmark_likelihood.png").stat().st_size > 10_000


def test_the_one_command_tells_what_failed(tmp_path):
    """Beside a copy of the command stand three that go wrong, each in a way of its own."""
    (tmp_path / "run.py").write_text((EXPERIMENTS / "run.py").read_text())
    wrong = {
        "crashes": "raise ValueError('three legs')",
        "forgets": "",
        "garbles": "import sys; open(sys.argv[2] + '/garbles.json', 'w').write('{')",
    }
    for name, code in wrong.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.py").write_text(f"# takes --quick\n{code}")
    command = [sys.executable, str(tmp_path / "run.py"), "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1 and "0 of 3 passed" in done.stdout
    for words in ("ValueError: three legs", "left no forgets.json", "garbles.json is no JSON"):
        assert words in done.stdout
    unknown = subprocess.run([*command, "walks"], capture_output=True, text=True)
    assert unknown.returncode == 2 and "no study 'walks'" in unknown.stderr


@pytest.fixture(scope="session")
def quickly():
    """XLA's older emitters compile in half the time; where there are none, without."""
    given = os.environ.get("XLA_FLAGS", "")
    there = os.environ | {"XLA_FLAGS": given + " --xla_cpu_use_fusion_emitters=false"}
    starts = [sys.executable, "-c", "import jax; jax.devices()"]
    done = subprocess.run(starts, env=there, capture_output=True)
    return dict(os.environ) if done.returncode else there


# each compiles for a minute or two: all of them with `pytest -m slow tests/test_experiments.py`
OFTEN = "particles"
MARKED = [pytest.param(name, marks=[pytest.mark.slow] * (name != OFTEN)) for name in STUDIES]


@pytest.mark.parametrize("name", MARKED)
def test_every_study_runs_quick_and_leaves_numbers_and_a_figure(name, quickly, tmp_path):
    done = run("--quick", name, "--out", tmp_path, env=quickly)
    log = tmp_path / name / "log.txt"
    assert done.returncode == 0, done.stdout + done.stderr + log.read_text()[-2000:]
    assert list((tmp_path / name).glob("*.png"))
