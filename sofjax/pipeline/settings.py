"""From the options of the command line to the settings of a run."""

import argparse
import dataclasses

from sofjax.cli.run import LOOPS
from sofjax.io.errors import InputError, nearest, quoted
from sofjax.io.settings import INLINE, read_toml, to_dict, with_settings
from sofjax.segment_map import MapConfig
from sofjax.slam import presets
from sofjax.slam.config import SlamConfig
from sofjax.vision import DETECTORS, FrontendSettings

FRONTENDS = {"paper": FrontendSettings(detector="hough")}  # of a preset; the default otherwise

CLOSINGS = {"paper": "none"}  # likewise; the paper closes by hand, where it knows of a loop

RECALL = 150  # images: the paper's closing is of a filter that does not find its start by itself

CHOICES = {
    "loop": LOOPS,
    "frontend.detector": tuple(DETECTORS),
    "filter.choice": ("resample", "winner"),
    "segment_map.rule": ("kalman", "gamma"),
}
LIMITS = {
    "seed": (0, 2**32 - 1),
    "frontend.capacity": (1, 4096),
    "filter.particles": (1, 1_000_000),
    "segment_map.capacity": (8, 65_536),
    "segment_map.candidates": (1, 8),
    "window.keyframes": (0, 64),
    "window.lines": (8, 1024),
    "association.temperature": (1e-3, 1e3),
}


@dataclasses.dataclass(frozen=True)
class RunSettings:
    """All that decides what a run writes, beside the drive."""

    seed: int
    frontend: FrontendSettings
    slam: SlamConfig = dataclasses.field(metadata=INLINE)
    loop: str = "smooth"  # after the drive: "none", the "paper"'s closing, or "smooth"


def gather(args: argparse.Namespace) -> RunSettings:
    """The default, changed by the file, by `--set`, and by the options of their own, in this order.

    In the file as in `--set`, a `preset` comes first, wherever it stands. The paper's closing
    brings its own `segment_map.recall`, unless one was given.
    """
    settings = _preset("default", "")
    if args.config is not None:
        settings = _changed(settings, read_toml(args.config), str(args.config))
    settings = _changed(settings, _pairs(args.sets), "--set")
    named = {
        "--particles": ("filter.particles", getattr(args, "particles", None)),
        "--seed": ("seed", getattr(args, "seed", None)),
        "--loop": ("loop", getattr(args, "loop", None)),
        "--detector": ("frontend.detector", getattr(args, "detector", None)),
    }
    for option, (name, value) in named.items():
        if value is not None:
            settings = _changed(settings, {name: value}, option)
    untouched = settings.slam.segment_map.recall == MapConfig().recall
    if settings.loop == "paper" and untouched:
        settings = with_settings(settings, {"segment_map.recall": RECALL}, "--loop")
    return settings


def _changed(settings: RunSettings, given: dict[str, object], where: str) -> RunSettings:
    given = dict(given)
    if "preset" in given:
        settings = dataclasses.replace(_preset(given.pop("preset"), where), seed=settings.seed)
    settings = with_settings(settings, given, where)
    check(settings, where)
    return settings


def _preset(name: object, where: str) -> RunSettings:
    if not isinstance(name, str) or name not in presets.PRESETS:
        hint = nearest(name if isinstance(name, str) else "", presets.PRESETS)
        raise InputError(f"{where}: there is no preset {quoted(name)}; {hint}")
    frontend = FRONTENDS.get(name, FrontendSettings())
    return RunSettings(0, frontend, presets.PRESETS[name], CLOSINGS.get(name, "smooth"))


def _pairs(sets: list[str]) -> dict[str, object]:
    given = {}
    for pair in sets:
        name, equals, value = pair.partition("=")
        if not equals or not name.strip():
            raise InputError(f"--set: {quoted(pair)} must have the form name=value")
        given[name.strip()] = value.strip()
    return given


def check(settings: RunSettings, where: str) -> None:
    """Refuse what no run can use, before anything is compiled for it."""
    for name, value in to_dict(settings).items():
        if name in CHOICES:
            if value not in CHOICES[name]:
                right = " or ".join(CHOICES[name])
                raise InputError(f"{where}: '{name}' is {quoted(value)}; it must be {right}")
        elif value < 0:
            raise InputError(f"{where}: '{name}' is {quoted(value)}; it must not be negative")
        elif name in LIMITS and not LIMITS[name][0] <= value <= LIMITS[name][1]:
            low, high = LIMITS[name]
            raise InputError(
                f"{where}: '{name}' is {quoted(value)}; it must be from {low} to {high}"
            )
