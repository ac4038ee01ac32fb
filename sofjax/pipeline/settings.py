"""The settings of a run: presets, files and options, and what no run can use."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from sofjax.io.camera_file import CameraFile
from sofjax.io.errors import InputError, nearest, quoted
from sofjax.io.settings import INLINE, Setting, read_toml, to_dict, with_settings
from sofjax.motion import MEANS
from sofjax.pipeline.outcomes import LOOPS
from sofjax.segment_map.types import MAP_RULES, MapConfig
from sofjax.slam import presets
from sofjax.slam.config import FILTER_CHOICES, LENGTHS, SlamConfig
from sofjax.vision import DETECTORS, FrontendSettings

FRONTEND = FrontendSettings()
RECALL = 150  # images: the paper's closing is of a filter that does not find its start by itself

CHOICES = {
    "loop": LOOPS,
    "filter.choice": FILTER_CHOICES,
    "segment_map.rule": MAP_RULES,
    "lengths": LENGTHS,
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
    """All that decides what a run writes, beside the drive. Refuses what no run can use."""

    seed: int = 0  # of the filter's random numbers
    frontend: FrontendSettings = FRONTEND
    slam: SlamConfig = dataclasses.field(default=presets.DEFAULT, metadata=INLINE)
    loop: str = "smooth"  # after the drive: "none", the "paper"'s closing, or "smooth"

    def __post_init__(self) -> None:
        for name, value in to_dict(self).items():
            check(name, value)

    @property
    def used(self) -> "RunSettings":
        """The settings as a run uses them: with what the choice of `loop` implies.

        The paper's closing needs `segment_map.recall` to be `RECALL`. A recall other than the
        default was chosen by the user and stays. What is implied is never written to
        `config.toml`: there another `loop` would keep it.
        """
        if self.loop != "paper" or self.slam.segment_map.recall != MapConfig().recall:
            return self
        return with_settings(self, {"segment_map.recall": RECALL}, "loop")

    def on(self, camera_file: CameraFile) -> "RunSettings":
        """The settings with what the robot's file knows of its odometer as their prior.

        What the user has set stays.
        """
        bias = zip(MEANS, camera_file.rig_fields.odometer, strict=True)
        unset = {name for name in MEANS if not getattr(self.slam.motion, name)}
        known = {f"motion.{name}": value for name, value in bias if name in unset and value}
        return with_settings(self, known, "camera.yaml")


def check(name: str, value: Setting) -> None:
    """Refuse a setting that no run can use, before anything is compiled for it.

    **Raises:** `ValueError` with what would be right.
    """
    right = _what_is_right(name, value)
    if right:
        raise ValueError(f"'{name}' is {quoted(value)}; it must {right}")


def _what_is_right(name: str, value: Setting) -> str:
    """What a setting must be; empty if it is."""
    choices = tuple(DETECTORS) if name == "frontend.detector" else CHOICES.get(name)
    if choices is not None:
        return "" if value in choices else f"be {' or '.join(choices)}"
    assert not isinstance(value, str), name
    if isinstance(value, float) and not math.isfinite(value):
        return "be finite"
    if value < 0 and name.removeprefix("motion.") not in MEANS:
        return "not be negative"
    low, high = LIMITS.get(name, (value, value))
    return "" if low <= value <= high else f"be from {low} to {high}"


PRESETS = {name: RunSettings(slam=slam) for name, slam in presets.PRESETS.items()} | {
    # the paper closes by hand, where it knows of a loop
    "paper": RunSettings(
        frontend=FrontendSettings(detector="hough"), slam=presets.PAPER, loop="none"
    )
}


def gather(
    config: Path | None = None,
    sets: Sequence[str] = (),
    options: Mapping[str, tuple[str, object]] | None = None,
) -> RunSettings:
    """The default, changed by a file, by pairs, and by options, in this order.

    In the file as in the pairs, a `preset` comes first, wherever it stands.

    **Arguments:**
    - `config`: a TOML file.
    - `sets`: pairs `name=value`.
    - `options`: by the option's name, which errors quote, the setting's name and its value; an
      option whose value is None changes nothing.

    **Raises:** `InputError` with the file or option and what would be right.
    """
    settings = PRESETS["default"]
    if config is not None:
        settings = _changed(settings, read_toml(config), str(config))
    settings = _changed(settings, _pairs(sets), "--set")
    for option, (name, value) in (options or {}).items():
        if value is not None:
            settings = _changed(settings, {name: value}, option)
    return settings


def _changed(settings: RunSettings, given: Mapping[str, object], where: str) -> RunSettings:
    given = dict(given)
    if "preset" in given:
        preset = _preset(given.pop("preset"), where)
        settings = dataclasses.replace(preset, seed=settings.seed)
    return with_settings(settings, given, where, check)


def _preset(name: object, where: str) -> RunSettings:
    if not isinstance(name, str) or name not in PRESETS:
        hint = nearest(name if isinstance(name, str) else "", PRESETS)
        raise InputError(f"{where}: there is no preset {quoted(name)}; {hint}")
    return PRESETS[name]


def _pairs(sets: Sequence[str]) -> dict[str, object]:
    given = {}
    for pair in sets:
        name, equals, value = pair.partition("=")
        if not equals or not name.strip():
            raise InputError(f"--set: {quoted(pair)} must have the form name=value")
        given[name.strip()] = value.strip()
    return given
