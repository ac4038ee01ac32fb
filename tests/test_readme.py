"""What the README says is so."""

import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

from sofjax.cli.arguments import make_parser

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
    assert "lines" in done.stdout and "best" in done.stdout


def test_the_commands_that_it_shows_are_understood():
    for line in "".join(blocks("sh")).splitlines():
        for command in re.findall(r"sofjax ([^;&]*)", line):
            make_parser().parse_args(shlex.split(command.replace("$seed", "1"), comments=True))


def test_what_it_links_to_and_names_is_there():
    for path in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / path).is_file(), path
    for path in re.findall(r"`(sofjax/[\w/.]+)`", README):
        assert (ROOT / path).exists(), path


def test_it_is_short():
    assert len(README.splitlines()) <= 160
