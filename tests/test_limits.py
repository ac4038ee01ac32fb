"""Files that are small, or look it, and unfold: a sentence within seconds and a bounded memory.

Each is read in a process of its own, without the checks of types that the tests add to every call.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

OFFICE = Path(__file__).parent.parent / "examples" / "office"
SECONDS, MEBIBYTES = 3, 300

READERS = {
    "drive": "from sofjax.io.drive import read_drive as read",
    "map": "from sofjax.io.map_file import read_map as read",
    "settings": "from sofjax.io.settings import read_toml as read",
    "camera": "from sofjax.io.camera_file import read_camera as read",
}


def refused(files):
    """For each (kind, path): the seconds that it took to refuse it, and the sentence; and the MiB
    that all of them together took at most. In one process, as starting one takes longer."""
    code = """
import json, resource, sys, time
from sofjax.io.errors import InputError
memory = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
readers, files = json.load(sys.stdin)
for kind in readers:
    exec(readers[kind])
    readers[kind] = read
before, done = memory(), []
for kind, path in files:
    begun = time.process_time()
    try:
        readers[kind](path)
        done.append([0, "was read"])
    except InputError as error:
        done.append([time.process_time() - begun, str(error)])
print(json.dumps([done, memory() - before]))
"""
    given = json.dumps([READERS, files])
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True, input=given)
    return json.loads(done.stdout)


TABLES = {
    "a million images": ("rgb.txt", lambda: "".join(f"{i} rgb/{i}.jpg\n" for i in range(10**6))),
    "missing images": ("rgb.txt", lambda: "".join(f"{i} rgb/{i}.jpg\n" for i in range(250_000))),
    "a million folders": ("rgb.txt", lambda: "0 " + "a/" * 10**6 + "b.jpg\n"),
    "a folder each": ("rgb.txt", lambda: "".join(f"{i} {i}/a.jpg\n" for i in range(100_000))),
    "blank lines": ("odometry.txt", lambda: "\n" * 200_000_000),
    "a line without end": ("odometry.txt", lambda: "# " + "x" * 200_000_000),
    "numbers without end": ("odometry.txt", lambda: "1 " * 20_000_000),
    "too many bytes": ("odometry.txt", lambda: "#\n" * 150_000_000),
}


def test_tables_that_unfold(tmp_path):
    for bomb, (name, text) in TABLES.items():
        drive = tmp_path / bomb
        drive.mkdir()
        for file in ("camera.yaml", "odometry.txt"):
            shutil.copy(OFFICE / file, drive)
        shutil.copy(OFFICE / "rgb" / "000000.jpg", drive)
        (drive / "rgb.txt").write_text("0.0 000000.jpg\n")
        (drive / name).write_text(text())
    done, mebibytes = refused([("drive", str(tmp_path / bomb)) for bomb in TABLES])
    for (bomb, (name, _)), (seconds, sentence) in zip(TABLES.items(), done, strict=True):
        assert name in sentence and len(sentence) < 400, bomb
        assert seconds < SECONDS, bomb
    assert mebibytes < MEBIBYTES


DOCUMENTS = {
    "dots": ("settings", "a" + ".a" * 45_000 + " = 1"),
    "more than a file may have": ("settings", "a" + ".a" * 300_000 + " = 1"),
    "dots of a table": ("settings", "[a" + ".a" * 45_000 + "]"),
    "a long name": ("settings", "a" * 90_000),
    "deep lists": ("settings", "a = " + "[" * 90_000),
    "a number of many digits": ("settings", "a = " + "9" * 90_000),
    "deep JSON": ("map", "[" * 1_000_000),
    "a long word": ("map", '"' + "a" * 10_000_000),
    "empty features": ("map", '{"features": [' + ",".join(["{}"] * 3_000_000) + "]}"),
    "a number of seen": ("map", '{"features": [{"seen": ' + "9" * 5_000_000 + "}]}"),
    "empty lists": ("map", '{"features": [' + ",".join(["[]"] * 5_000_000) + "]}"),
    "empty names": ("map", '{"features": [' + ",".join(['{"":0}'] * 1_900_000) + "]}"),
    "a list of numbers": ("camera", "a: [" + "1," * 45_000 + "]"),
    "colons": ("camera", "image_width: " + "1:" * 2500 + "1"),
    "digits": ("camera", "image_width: " + "1" * 90_000),
    "braces": ("camera", "{" * 90_000),
    "words": ("camera", "- a\n" * 10_000),
}


def test_documents_that_unfold(tmp_path):
    files = []
    for i, (kind, text) in enumerate(DOCUMENTS.values()):
        (tmp_path / f"file-{i}").write_text(text)
        files.append((kind, str(tmp_path / f"file-{i}")))
    done, mebibytes = refused(files)
    for bomb, (seconds, sentence) in zip(DOCUMENTS, done, strict=True):
        assert "file-" in sentence and len(sentence) < 400, bomb
        assert seconds < SECONDS, bomb
    assert mebibytes < MEBIBYTES


@pytest.mark.parametrize("where", ["truth", "map"])
def test_a_comparison_of_long_lines_has_no_more_memory(where):
    """A thousand lines of ten kilometres."""
    code = """
import resource, sys
import numpy as np
from sofjax.evaluation import RigidMotion, evaluate_map
memory = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
long = np.zeros((1000, 2, 2))
long[:, 1, 0], long[:, :, 1] = 1e4, np.arange(1000)[:, None]
short = np.array([[[0.0, 0.0], [1.0, 0.0]]])
truth, found = (long, short) if sys.argv[1] == "truth" else (short, long)
before = memory()
evaluate_map(truth, found, RigidMotion(np.eye(2), np.zeros(2)), short[0])
print(memory() - before)
"""
    command = [sys.executable, "-c", code, where]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    assert float(done.stdout) < MEBIBYTES
