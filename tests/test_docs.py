"""What the pages of the documentation say is so."""

import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import pytest

from sofjax.cli.arguments import make_parser
from sofjax.io.camera_file import read_camera
from sofjax.io.settings import to_dict
from sofjax.pipeline import RunSettings

ROOT = Path(__file__).parent.parent
PAGES = {
    page.stem: page.read_text()
    for page in sorted((ROOT / "docs").glob("*.md"))
    if page.stem not in ("api", "settings", "studies")  # made of the code
}
COSTLY = ("calibrate", "many_particles")  # minutes each


def blocks(text, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


def run(name):
    code = "\n".join(blocks(PAGES[name], "python"))
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


WITH_CODE = [name for name in PAGES if blocks(PAGES[name], "python")]


@pytest.mark.parametrize("name", [name for name in WITH_CODE if name not in COSTLY])
def test_the_code_of_a_page_runs(name):
    run(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", COSTLY)
def test_the_code_of_a_costly_page_runs(name):
    run(name)


@pytest.mark.parametrize("name", PAGES)
def test_the_commands_of_a_page_are_understood(name):
    for line in "".join(blocks(PAGES[name], "sh")).splitlines():
        for command in re.findall(r"(?<![/\w])(?:\.venv/bin/)?sofjax ([^;&]*)", line):
            make_parser().parse_args(shlex.split(command, comments=True))


def test_the_camera_file_that_is_shown_is_read(tmp_path):
    (text,) = blocks(PAGES["formats"], "yaml")
    (tmp_path / "camera.yaml").write_text(text)
    folders = tmp_path, ROOT / "examples" / "office"
    shown, sample = (read_camera(folder / "camera.yaml") for folder in folders)
    assert eqx.tree_equal(shown.mount, sample.mount)


def generated():
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_of_settings_has_all_that_a_run_lists():
    page = generated().settings_page()
    listed = set(re.findall(r"^\| `([a-z_.]+)` ", page, re.MULTILINE))
    of_a_run = set(to_dict(RunSettings()))
    assert of_a_run <= listed, of_a_run - listed
    assert not re.findall(r"^\| `.*\| +\|$", page, re.MULTILINE)  # each says what it is


def test_what_the_pages_link_to_is_there():
    made = generated()
    files = {"api.md": made.api_page(), "settings.md": made.settings_page(), "studies.md": ""}
    files |= {f"{name}.md": text for name, text in PAGES.items()}
    slug = lambda title: re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-").replace("_", "-")
    for name, text in PAGES.items():
        for file, _, anchor in re.findall(r"\]\(([\w.]+\.md)(#([\w-]+))?\)", text):
            assert file in files, f"{name}: {file}"
            titles = re.findall(r"^#+ (.*)$", files[file], re.MULTILINE)
            assert not anchor or anchor in {slug(title) for title in titles}, f"{name}: {anchor}"
