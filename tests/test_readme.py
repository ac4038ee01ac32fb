"""What the README says is so."""

import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import equinox as eqx

from sofjax.cli.arguments import make_parser
from sofjax.io.camera_file import read_camera
from sofjax.io.settings import to_dict
from sofjax.pipeline.settings import RunSettings
from sofjax.slam import presets
from sofjax.vision import FrontendSettings

ROOT = Path(__file__).parent.parent
OFFICE = ROOT / "examples" / "office"
README = (ROOT / "README.md").read_text()


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)


def test_the_first_two_shell_lines_set_everything_up():
    """`.ci/run` executes the first block line by line, and so can nobody forget one of them."""
    run, test = blocks("sh")[0].splitlines()
    assert "pip install" in run and "sofjax run examples/office" in run
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert re.search(r"\.\[(\w+)\]", run)[1] in project["optional-dependencies"]
    assert "'.[tests]'" in test and test.endswith("-m pytest -n 2")


def test_the_python_blocks_run_one_after_the_other():
    code = "\n".join(blocks("python"))
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "lines" in done.stdout and "per metre" in done.stdout


def test_the_commands_that_it_shows_are_understood():
    for line in "".join(blocks("sh")).splitlines():
        for command in re.findall(r"sofjax ([^;&]*)", line):
            make_parser().parse_args(shlex.split(command.replace("$seed", "1"), comments=True))


def test_the_camera_file_that_it_shows_is_read(tmp_path):
    (text,) = blocks("yaml")
    (tmp_path / "camera.yaml").write_text(text)
    shown, sample = (read_camera(folder / "camera.yaml") for folder in (tmp_path, OFFICE))
    assert eqx.tree_equal(shown.mount, sample.mount)


def test_what_it_links_to_and_names_is_there():
    for path in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / path).is_file(), path
    for path in re.findall(r"`(sofjax/[\w/]+\.py)`", README):
        assert (ROOT / path).is_file(), path


def test_the_settings_that_it_names_exist():
    known = to_dict(RunSettings(0, FrontendSettings(), presets.PRESETS["default"]))
    section = README.split("## Settings")[1].split("\n## ")[0]
    named = re.findall(r"\b[a-z_]+\.[a-z_]+\b(?!\.)", section)
    named = [name for name in named if not name.endswith(".toml")]
    assert named and set(named) <= set(known)
