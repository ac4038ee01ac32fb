"""The lowest versions that `pyproject.toml` promises are enough, and nothing is used but stated."""

import ast
import re
import subprocess
import sys
import tomllib
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PACKAGE = {"cv2": "opencv-python-headless", "yaml": "pyyaml"}  # where it has another name
TRIED = (  # what leans on each dependency; the sample drive is run besides
    "tests/test_geometry_floor.py",
    "tests/test_motion.py",
    "tests/test_likelihood.py",
    "tests/test_vision.py",
    "tests/test_calibrate_camera.py",
    "tests/test_evaluation.py",
)


def name_of(requirement):
    return re.match(r"[\w-]+", requirement)[0]


def imported_packages():
    for file in (ROOT / "sofjax").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module]
            yield from (name.partition(".")[0] for name in names)


def test_every_dependency_states_its_lowest_version():
    for requirement in PROJECT["dependencies"]:
        assert re.fullmatch(r"[\w-]+>=\d+(\.\d+)+", requirement), requirement


def test_every_package_that_is_imported_is_a_dependency():
    figures = PROJECT["optional-dependencies"]["figures"]
    stated = {name_of(requirement) for requirement in [*PROJECT["dependencies"], *figures]}
    others = set(imported_packages()) - sys.stdlib_module_names - {"sofjax"}
    assert {PACKAGE.get(name, name) for name in others} == stated


@pytest.mark.slow
def test_the_lowest_versions_are_enough(tmp_path):
    """In an environment of their own: some tests, and the sample drive from end to end."""
    venv.create(tmp_path / "lowest", with_pip=True)
    folder = tmp_path / "lowest" / "bin"
    lowest = [requirement.replace(">=", "==") for requirement in PROJECT["dependencies"]]
    run = lambda *command: subprocess.run([folder / command[0], *command[1:]], cwd=ROOT, check=True)
    run("python", "-m", "pip", "install", "-q", "-e", ".[tests]", *lowest)
    run("python", "-m", "pytest", "-q", *TRIED)
    run("sofjax", "run", "examples/office", "--out", str(tmp_path / "office"))
