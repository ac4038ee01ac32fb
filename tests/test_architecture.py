"""The direction of imports, what each room may know, and the sizes of files and functions."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import sofjax

PACKAGE = Path(__file__).parent.parent / "sofjax"
FILES = sorted(PACKAGE.rglob("*.py"))
EXPERIMENTS = PACKAGE.parent / "experiments"

# each room imports from those before it; to add one is to say where it stands
ROOMS = """
    _checks _pytree geometry extraction motion rig likelihood particles segment_map slam smoothing
    loop_closure calibration io vision evaluation simulation viewer pipeline cli
""".split()
CORE = ROOMS[: ROOMS.index("io")]
MATHS = {"jax", "jaxtyping", "equinox", "optimistix", "lineax", "numpy", "sofjax"}


def room_of(file):
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def in_room(*rooms):
    return [file for file in FILES if room_of(file) in rooms]


def imports(file):
    """Every module that a file names, inside functions too; `from sofjax import x` is sofjax.x."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: imports are absolute"
            if node.module == "sofjax":
                yield from (f"sofjax.{alias.name}" for alias in node.names)
            else:
                yield node.module


def calls(file):
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            yield node.func.id


def names(files):
    return [str(file.relative_to(PACKAGE)) for file in files]


@pytest.mark.parametrize(
    "file",
    [f for f in FILES if not room_of(f).startswith("__")],
    ids=lambda f: str(f.relative_to(PACKAGE)),
)
def test_imports_point_one_way(file):
    assert room_of(file) in ROOMS, "a room of its own has a place in ROOMS"
    for module in imports(file):
        top, *inner = module.split(".")
        if top == "sofjax" and inner:
            assert ROOMS.index(inner[0]) <= ROOMS.index(room_of(file)), module


def test_the_ground_knows_jax_and_equinox_alone():
    for file in in_room("geometry"):
        modules = {module.split(".")[0] for module in imports(file)} - sys.stdlib_module_names
        assert modules <= MATHS - {"numpy", "optimistix"}, file


def test_the_core_knows_no_more_than_mathematics():
    for file in in_room(*CORE):
        modules = {module.split(".")[0] for module in imports(file)}
        assert modules - sys.stdlib_module_names <= MATHS, file


@pytest.mark.parametrize(
    ("library", "rooms"), [("cv2", {"vision", "simulation"}), ("matplotlib", {"viewer"})]
)
def test_a_heavy_library_is_known_in_one_place(library, rooms):
    knowing = [f for f in FILES if any(m.split(".")[0] == library for m in imports(f))]
    assert {room_of(file) for file in knowing} <= rooms, names(knowing)
    assert names(f for f in knowing if room_of(f) == "simulation") in (
        [],
        ["simulation/rendering/renderer.py"],
    )


def test_the_core_opens_no_file_and_only_commands_print():
    opening = {"open", "print", "input", "exit"}
    assert not names(f for f in in_room(*CORE, "__init__") if opening & set(calls(f)))
    assert {room_of(file) for file in FILES if "print" in calls(file)} <= {"cli"}
    exits = {file for file in FILES if {"exit", "quit"} & set(calls(file))}
    assert {room_of(file) for file in exits} <= {"cli", "__main__"}


@pytest.mark.parametrize(
    "file", sorted(EXPERIMENTS.rglob("*.py")), ids=lambda f: str(f.relative_to(EXPERIMENTS))
)
def test_experiments_use_what_the_rooms_offer(file):
    for module in imports(file):
        top, *inner = module.split(".")
        assert top != "sofjax" or len(inner) <= 1 + (inner[:1] == ["io"]), module


def functions(file):
    """Every function of a file, nested ones and methods too, and its arguments but `self`."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            given = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
            yield node, [a for a in given if a.arg not in ("self", "cls")]


def test_no_function_is_longer_than_a_screen_or_takes_many_arguments():
    long, many = [], []
    for file in FILES:
        for node, arguments in functions(file):
            doc = ast.get_docstring(node, clean=False) or ""
            lines = node.end_lineno - node.lineno + 1 - len(doc.splitlines())
            long += [f"{file.name}:{node.name} {lines}"] * (lines > 60)
            many += [f"{file.name}:{node.name} {len(arguments)}"] * (len(arguments) > 8)
    assert not long and not many


def test_no_file_is_long():
    tests = sorted(Path(__file__).parent.glob("*.py"))
    limits = dict.fromkeys(FILES, 300) | dict.fromkeys(tests, 350)
    lines = {file: len(file.read_text().splitlines()) for file in limits}
    assert not [f"{file.name} {lines[file]}" for file in limits if lines[file] > limits[file]]


def test_functions_are_annotated():
    found = [each for file in FILES for each in functions(file)]
    bare = [
        node.name
        for node, arguments in found
        if node.returns is None or any(a.annotation is None for a in arguments)
    ]
    assert len(bare) <= 0.03 * len(found), bare


def test_no_imports_run_in_a_circle():
    """Those inside functions count too."""
    path = lambda file: file.relative_to(PACKAGE.parent).with_suffix("").parts
    modules = {".".join(path(file)).removesuffix(".__init__"): file for file in FILES}
    left = {name: set() for name in modules}
    for name, file in modules.items():
        for node in ast.walk(ast.parse(file.read_text())):
            for alias in node.names if isinstance(node, ast.ImportFrom) else ():
                inner = f"{node.module}.{alias.name}"
                left[name].add(inner if inner in modules else node.module)
    while ends := [name for name in left if not left[name] & left.keys()]:
        for name in ends:
            del left[name]
    assert not left, "each of these imports another of them"


def modules_after(code):
    code = f"import sys; {code}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_the_package_loads_nothing_heavy():
    heavy = {"cv2", "matplotlib", "optimistix", "scipy", "yaml"}
    assert not heavy & modules_after("import sofjax")
    rooms = ", ".join(f"sofjax.{room}" for room in CORE if in_room(room))
    assert not {"cv2", "matplotlib", "yaml"} & modules_after(f"import {rooms}")


def test_every_public_name_is_there():
    for name in sofjax.__all__:
        assert getattr(sofjax, name) is not None
        assert name in dir(sofjax)
    with pytest.raises(AttributeError, match="nothing"):
        sofjax.nothing  # noqa: B018
