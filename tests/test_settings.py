"""Every setting that a run lists changes what it says it changes, or is refused."""

import dataclasses
import functools
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import make_camera
from jax.interpreters.partial_eval import dce_jaxpr

from sofjax import PRESETS, SE2, Mount, Observation, Segments, SofSlam
from sofjax.cli.arguments import make_parser
from sofjax.cli.run import settings_of
from sofjax.io.camera_file import read_camera
from sofjax.io.errors import InputError
from sofjax.io.settings import read_toml, to_dict, to_toml, with_settings
from sofjax.pipeline import RunSettings
from sofjax.pipeline.settings import CHOICES, LIMITS, gather
from sofjax.segment_map import MapConfig, final_map, is_shown
from sofjax.vision import DETECTORS, Frontend, FrontendSettings, detect_lsd

OFFICE = Path(__file__).parent.parent / "examples" / "office"
M = 4
SMALL = {"filter.particles": 20, "segment_map.capacity": 16, "segment_map.nearby": 8}
SOFT = {"filter.soft": True, "filter.gate_each": True}
WINDOW = {"window.keyframes": 2, "window.lines": 8}

# static settings: another value is another program; each with the mode in which it counts
STATIC = {
    "filter.particles": (21, {}),
    "filter.choice": ("winner", {}),
    "filter.gate_each": (True, {}),
    "filter.soft": (True, {}),
    "filter.doubts": (False, {}),
    "sensor.propagate": (False, {}),
    "segment_map.rule": ("gamma", {}),
    "segment_map.classify": (False, {}),
    "segment_map.directed": (True, {}),
    "segment_map.capacity": (17, {}),
    "segment_map.nearby": (7, {}),
    "segment_map.candidates": (2, {}),
    "window.keyframes": (3, WINDOW),
    "lengths": ("metres", {}),
    "window.lines": (9, WINDOW),
}
OF_THE_RUN = ("seed", "loop")
OF_THE_FRONTEND = ("frontend.detector", "frontend.capacity", "frontend.min_length")


def settings_with(changes, preset="default"):
    slam = dataclasses.replace(RunSettings(), slam=PRESETS[preset])
    return with_settings(slam, SMALL | changes, "here")


def traced(settings):
    """One image's step and the filter's final map, as a function of the settings; and its trace."""
    leaves, tree = jax.tree.flatten(settings.slam)
    mount = Mount.create(height=0.6, pitch=0.26, x=0.05)

    def step(leaves):
        slam = SofSlam(jax.tree.unflatten(tree, leaves), make_camera(), mount)
        observation = Observation(
            segments_image=Segments(jnp.zeros((M, 2, 2)), jnp.zeros(M, bool)),
            motion=SE2.identity(),
            overflow=jnp.zeros((), int),
        )
        state, info = slam.step(slam.init(jax.random.key(0), M), observation)
        return state, info, final_map(slam.config.segment_map, mount, state.segment_map)

    return jax.make_jaxpr(step)(leaves).jaxpr


def names_of_leaves(config, prefix=""):
    """Of the settings that are no part of the program, in the order of `jax.tree.leaves`."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from names_of_leaves(value, f"{prefix}{field.name}.")
        elif not field.metadata.get("static"):
            yield prefix + field.name


def read_by(settings):
    """The settings from which some output of the step or the map is computed."""
    jaxpr = traced(settings)
    _, used = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    names = names_of_leaves(settings.slam)
    return {name for name, is_used in zip(names, used, strict=True) if is_used}


def test_every_number_reaches_the_results():
    """By data flow: in one of four modes some output is computed from it."""
    read = read_by(settings_with({}))
    assert read_by(settings_with({}, "paper")) - read == {"sensor.rho_sigma", "sensor.theta_sigma"}
    assert read_by(settings_with(SOFT)) - read == {"association.temperature"}
    assert read_by(settings_with(WINDOW)) - read == {"window.step", "window.turn"}
    others = {
        *("sensor.rho_sigma", "sensor.theta_sigma", "association.temperature"),
        *("window.step", "window.turn", *STATIC, *OF_THE_RUN, *OF_THE_FRONTEND),
    }
    assert read.isdisjoint(others)
    assert read | others == set(to_dict(RunSettings()))


def test_the_final_map_of_the_default_run_reads_its_rule():
    """The smoother's map is decided by `is_shown` too; see test_classify.py."""
    config, lines = MapConfig(), jnp.ones(3, int)
    leaves, tree = jax.tree.flatten(config)
    rule = lambda leaves: is_shown(
        jax.tree.unflatten(tree, leaves), jnp.ones(3), jnp.ones(3), lines, lines
    )
    _, used = dce_jaxpr(jax.make_jaxpr(rule)(leaves).jaxpr, [True])
    names = zip(names_of_leaves(config), used, strict=True)
    scale = {f"scale_{name}" for name in ("above", "below", "gate", "known", "held")}
    assert {name for name, is_used in names if is_used} == scale | {"min_updates", "min_share"}


@functools.cache
def program(mode):
    return str(traced(settings_with(dict(mode))))


@pytest.mark.parametrize("name", STATIC)
def test_another_choice_is_another_program(name):
    value, mode = STATIC[name]
    assert to_dict(settings_with(mode))[name] != value
    assert str(traced(settings_with(mode | {name: value}))) != program(tuple(mode.items()))


def test_the_front_end_does_as_its_settings_say():
    view = lambda **settings: Frontend(
        read_camera(OFFICE / "camera.yaml"), FrontendSettings(**settings)
    ).view(OFFICE / "rgb" / "000000.jpg")
    usual, few, long = view(), view(capacity=5), view(min_length=40.0)
    assert len(few.segments_image.valid) == 5 < len(usual.segments_image.valid) == 64
    assert few.overflow == usual.detected - 5
    assert 0 < long.detected < usual.detected
    assert view(detector="hough").detected != usual.detected


# Detectors


@pytest.fixture
def mine():
    """A detector that a user has registered."""
    DETECTORS["mine"] = lambda image: detect_lsd(image)[:3]
    yield "mine"
    del DETECTORS["mine"]


def parsed(*args):
    return settings_of(make_parser().parse_args(["run", "drive", *args]))


def test_a_registered_detector_is_known_everywhere(mine):
    assert parsed("--detector", mine).frontend.detector == mine
    assert parsed("--set", f"frontend.detector={mine}").frontend.detector == mine
    settings = RunSettings(frontend=FrontendSettings(detector=mine))
    frontend = Frontend(read_camera(OFFICE / "camera.yaml"), settings.frontend)
    assert frontend.view(OFFICE / "rgb" / "000000.jpg").detected == 3


def test_a_detector_that_is_not_registered_is_refused_with_the_list(capsys):
    with pytest.raises(ValueError, match="lsd or hough"):
        FrontendSettings(detector="mine")
    with pytest.raises(InputError, match="'mine'; it must be lsd or hough"):
        parsed("--set", "frontend.detector=mine")
    with pytest.raises(SystemExit):
        parsed("--detector", "mine")
    assert "invalid choice: 'mine' (choose from 'lsd', 'hough')" in capsys.readouterr().err


# Values


@pytest.mark.parametrize("name", [*CHOICES, *LIMITS, "frontend.detector", "motion.slip_rate"])
def test_what_no_run_can_use_is_refused_by_name(name):
    """In the library and on the command line."""
    wrong = "best" if isinstance(to_dict(RunSettings())[name], str) else -1
    with pytest.raises(InputError, match=f"^--set: '{name}' is .*; it must "):
        gather(sets=[f"{name}={wrong}"])
    if name in ("seed", "loop"):
        with pytest.raises(ValueError, match=f"'{name}' is .*; it must "):
            RunSettings(**{name: wrong})


def test_a_preset_is_a_whole_run():
    paper = gather(sets=["preset=paper"])
    assert (paper.loop, paper.frontend.detector) == ("none", "hough")
    assert paper.slam.filter.choice == "winner"


def test_what_a_choice_of_loop_implies_does_not_outlive_it(tmp_path):
    """`config.toml` of a run with the paper's closing, run again with another."""
    paper = parsed("--loop", "paper")
    assert paper.used.slam.segment_map.recall == 150
    (tmp_path / "config.toml").write_text(to_toml(to_dict(paper)))
    assert "150" not in (tmp_path / "config.toml").read_text()
    again = parsed("--config", str(tmp_path / "config.toml"))
    assert again == paper and again.used.slam.segment_map.recall == 150
    smooth = parsed("--config", str(tmp_path / "config.toml"), "--loop", "smooth")
    assert smooth == RunSettings() and smooth.used is smooth
    # what the user has chosen stays
    own = parsed("--loop", "paper", "--set", "segment_map.recall=99")
    assert own.used.slam.segment_map.recall == 99


def test_a_setting_that_was_learned_is_a_number_in_the_file(tmp_path):
    learned = lambda value: RunSettings(
        slam=eqx.tree_at(lambda c: c.sensor.pixel_sigma, PRESETS["default"], jnp.float32(value))
    )
    (tmp_path / "c.toml").write_text(to_toml(to_dict(learned(0.75))))
    assert gather(tmp_path / "c.toml").slam.sensor.pixel_sigma == 0.75
    with pytest.raises(ValueError, match=r"pixel_sigma' is nan; it must be finite"):
        learned(jnp.nan)


def test_settings_are_read_back_number_for_number(tmp_path):
    settings = gather(sets=["motion.distance_noise=0.1", "seed=3", "filter.soft=true"])
    (tmp_path / "c.toml").write_text(to_toml(to_dict(settings)))
    assert gather(tmp_path / "c.toml") == settings
    assert read_toml(tmp_path / "c.toml") == to_dict(settings)
    assert np.isclose(settings.slam.motion.distance_noise, 0.1)
