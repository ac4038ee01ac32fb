"""What the README says is so."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

from sofjax import presets
from sofjax.cli.settings import RunSettings
from sofjax.io.settings import to_dict
from sofjax.vision import FrontendSettings

ROOT = Path(__file__).parent.parent
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
