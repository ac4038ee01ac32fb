"""The pages that are made: of the fields of settings, of docstrings, of the index of studies."""

import ast
import dataclasses
import importlib
import inspect
import io
import re
import textwrap
import tokenize
from pathlib import Path
from types import ModuleType

from sofjax.pipeline import RunSettings
from sofjax.slam import SlamConfig

MODULES = {  # the API page, from the ground up
    "sofjax.geometry": "The ground: eqs. (1) to (8) and (10) to (13)",
    "sofjax.extraction": "Segments on the floor: eq. (9) and Fig. 5",
    "sofjax.extraction.association": "Association, eq. (9)",
    "sofjax.motion": "The motion model and the odometer's systematic errors",
    "sofjax.likelihood": "The sensor model for many poses",
    "sofjax.likelihood.sensor_model": "The sensor model, stated once",
    "sofjax.likelihood.tracking": "The sensor model near a predicted pose",
    "sofjax.particles": "Particles",
    "sofjax.segment_map": "The map",
    "sofjax.slam": "The filter",
    "sofjax.slam.step": "One round of Fig. 6",
    "sofjax.slam.fixed_lag": "The last keyframes, solved for while driving",
    "sofjax.smoothing": "All poses and lines at once",
    "sofjax.loop_closure": "Places seen again",
    "sofjax.calibration": "The mount from a drive",
    "sofjax.pipeline": "A drive in, its result out",
    "sofjax.evaluation": "Errors against a truth",
    "sofjax.vision": "Images to segments",
    "sofjax.io.drive": "Drives in files",
    "sofjax.simulation": "Worlds to drive through",
}
SETTINGS = {  # of a run, by the first part of their names
    "association": ("sofjax.extraction.association", "Association"),
    "motion": ("sofjax.motion", "MotionModel"),
    "sensor": ("sofjax.likelihood.sensor_model", "SensorModel"),
    "segment_map": ("sofjax.segment_map", "MapConfig"),
    "filter": ("sofjax.slam", "FilterConfig"),
    "window": ("sofjax.slam", "FixedLagConfig"),
    "frontend": ("sofjax.vision", "FrontendSettings"),
}


def write(folder: Path) -> None:
    """Write both pages into a folder, if they have changed."""
    pages = {"settings.md": settings_page(), "api.md": api_page(), "studies.md": studies_page()}
    for name, text in pages.items():
        file = folder / name
        if not file.exists() or file.read_text() != text:
            file.write_text(text)


def studies_page() -> str:
    """The index of `experiments/`, without its links to the pages beside it."""
    index = Path(__file__).parents[1] / "experiments" / "README.md"
    return re.sub(r"\[`(\w+/)`\]\([^)]*\)", r"`experiments/\1`", index.read_text())


def settings_page() -> str:
    """Every setting of a run, with its default and the comment beside its field."""
    out = [
        "# Settings",
        "Every setting is a field with a default, beside the code that reads it. A run writes them "
        "all into its `config.toml`; `--set sensor.pixel_sigma=0.8` changes one, `--config FILE` "
        "reads a file, and `--set preset=paper` brings the paper's choices back. What is unknown "
        "or out of range is refused with a sentence.",
        "Worth a thought for a new robot: `motion.*_sigma` (how wrong the odometer may be at all), "
        "`motion.*_noise` (how it scatters), `sensor.tilt_sigma` (how the mount shakes) and "
        "`sensor.pixel_sigma`. Rather too large than too small.",
    ]
    comments = field_comments(RunSettings)
    own = [(name, getattr(RunSettings(), name), comments[name]) for name in ("seed", "loop")]
    lengths = field_comments(SlamConfig)["lengths"]
    own += [("lengths", SlamConfig().lengths, f"what lengths of the settings are in: {lengths}")]
    out += ["## A run", _rows(own)]
    for prefix, (module, name) in SETTINGS.items():
        kind = getattr(importlib.import_module(module), name)
        out += [f"## {prefix}", f"`{name}`: {_first_paragraph(kind)}", _table(prefix, kind)]
    return "\n\n".join(out) + "\n"


def _table(prefix: str, kind: type) -> str:
    comments = field_comments(kind)
    return _rows([
        (f"{prefix}.{field.name}", field.default, comments.get(field.name, ""))
        for field in dataclasses.fields(kind)
    ])  # fmt: skip


def _rows(settings: list[tuple[str, object, str]]) -> str:
    rows = ["| setting | default | |", "|---|---|---|"]
    for name, default, about in settings:
        about = about.replace("|", "\\|")
        rows.append(f"| `{name}` | `{default!r}` | {about} |")
    return "\n".join(rows)


def field_comments(kind: type) -> dict[str, str]:
    """The comment of each field, on its own lines or on those before it."""
    source = textwrap.dedent(inspect.getsource(kind))
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokens
        if token.type == tokenize.COMMENT and "fmt:" not in token.string
    }
    lines = source.splitlines()
    found = {}
    for node in ast.parse(source).body[0].body:
        if isinstance(node, ast.AnnAssign):
            first = node.lineno
            while lines[first - 2].strip().startswith("#"):
                first -= 1
            said = [comments[n] for n in range(first, node.end_lineno + 1) if n in comments]
            found[node.target.id] = " ".join(said)
    return found


def api_page() -> str:
    """The docstrings of what each module offers."""
    out = [
        "# API",
        "Units are metres, radians, seconds and pixels. Shapes stand in the annotations: "
        '`Float[Array, "N 3 3"]`. Names end in their frame, and `T_a_b` takes coordinates of b '
        "into a.",
    ]
    seen = set()
    for name, title in MODULES.items():
        module = importlib.import_module(name)
        out += [f"## {title}", f"`{name}`", inspect.cleandoc(module.__doc__ or "")]
        for member in _members(module):
            thing = getattr(module, member)
            if id(thing) not in seen:
                out.append(_entry(member, thing))
                seen.add(id(thing))
    return "\n\n".join(part for part in out if part) + "\n"


def _members(module: ModuleType) -> list[str]:
    if hasattr(module, "_HOME"):
        return list(module._HOME)
    exported = hasattr(module, "__path__")
    own = lambda thing: exported or getattr(thing, "__module__", "") == module.__name__
    return [
        name
        for name, thing in vars(module).items()
        if not name.startswith("_") and callable(thing) and inspect.getdoc(thing) and own(thing)
        and not inspect.ismodule(thing) and getattr(thing, "__module__", "").startswith("sofjax")
    ]  # fmt: skip


def _entry(name: str, thing: object) -> str:
    inner = inspect.unwrap(thing) if not inspect.isclass(thing) else thing
    text = inspect.getdoc(inner) or ""
    parts = [f"### {name}", f"```python\n{_signature(name, inner)}\n```", text]
    if inspect.isclass(inner):
        for method, function in vars(inner).items():
            plain = getattr(function, "__wrapped__", getattr(function, "__func__", function))
            if method.startswith("_") or not inspect.isfunction(plain) or not plain.__doc__:
                continue
            signature = _signature(f"{name}.{method}", plain)
            parts += [f"```python\n{signature}\n```", inspect.getdoc(plain) or ""]
    return "\n\n".join(part for part in parts if part)


def _signature(name: str, thing: object) -> str:
    """As it is written, without the strings around annotations."""
    try:
        source = textwrap.dedent(inspect.getsource(thing))
        node = ast.parse(source).body[0]
    except (OSError, TypeError, SyntaxError, IndentationError):
        return name
    if isinstance(node, ast.ClassDef):
        fields = [ast.unparse(n) for n in node.body if isinstance(n, ast.AnnAssign)]
        return "\n".join([f"class {name}:", *(f"    {field}" for field in fields or ["..."])])
    if not isinstance(node, ast.FunctionDef):
        return name
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    arguments = ast.unparse(node.args).replace("self, ", "").replace("self", "")
    line = f"{name}({arguments}){returns}"
    if len(line) <= 90:
        return line
    each = [a for a in _split(arguments)]
    return "\n".join([f"{name}(", *(f"    {a}," for a in each), f"){returns}"])


def _split(arguments: str) -> list[str]:
    parts, depth, start = [], 0, 0
    for i, c in enumerate(arguments):
        depth += (c in "([{") - (c in ")]}")
        if c == "," and depth == 0:
            parts.append(arguments[start:i].strip())
            start = i + 1
    return [*parts, arguments[start:].strip()]


def _first_paragraph(kind: type) -> str:
    return " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split())


if __name__ == "__main__":
    write(Path(__file__).parent)
