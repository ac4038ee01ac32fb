"""What lies on the floor, and the final map's rule, by worked examples."""

import dataclasses

import jax.numpy as jnp
import pytest

from sofjax.segment_map import MapConfig, is_shown, scale_is_off_floor

CONFIG = MapConfig(min_updates=5, min_share=0.25)


def shown(scale, sigma, updates=20, expected=20, config=CONFIG):
    numbers = (jnp.array(scale), jnp.array(sigma), jnp.array(updates), jnp.array(expected))
    return bool(is_shown(config, *numbers))


@pytest.mark.parametrize(
    ("scale", "sigma", "is_line_shown"),
    [
        (1.01, 0.01, True),
        (1.10, 0.02, False),  # off the floor
        (1.05, 0.02, True),  # outside the range of floors, but not significantly
        (1.02, 0.04, True),  # nearly known, and the floor's
        (1.10, 0.04, False),  # nearly known, and perhaps the top of a baseboard
        (1.02, 0.10, False),  # unknown
        (0.60, 0.02, False),  # a reflection
    ],
)
def test_lines_whose_height_is_known_to_be_the_floor_s_are_shown(scale, sigma, is_line_shown):
    assert shown(scale, sigma) == is_line_shown


@pytest.mark.parametrize(
    ("updates", "expected", "is_line_shown"),
    [(4, 4, False), (5, 5, True), (5, 20, True), (5, 21, False), (30, 10, True)],
)
def test_lines_are_shown_that_were_seen_often_and_in_a_fair_share(updates, expected, is_line_shown):
    assert shown(1.0, 0.01, updates, expected) == is_line_shown


def test_without_heights_every_line_is_the_floor_s():
    paper = dataclasses.replace(CONFIG, classify=False)
    assert shown(1.3, 0.2, config=paper) and not shown(1.3, 0.2, updates=4, config=paper)
    assert not scale_is_off_floor(paper, jnp.array(1.3), jnp.array(0.01))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"rule": "Gamma"}, "MapConfig.rule must be 'kalman' or 'gamma', not 'Gamma'"),
        ({"capacity": 0}, "MapConfig.capacity must be a whole number from 1 on, not 0"),
        ({"range": -1.0}, "MapConfig.range must be a number above 0, not -1.0"),
        ({"min_share": float("nan")}, "MapConfig.min_share must be a number from 0 on, not nan"),
    ],
)
def test_settings_that_are_none_are_refused(wrong, said):
    with pytest.raises(ValueError, match=said):
        MapConfig(**wrong)
