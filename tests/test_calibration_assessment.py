"""A fit says how well it is known, and is refused where the drive does not show the mount."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from line_pairs import N, begin, changes, fit_mount, make_pairs, true_mount, value, weighed

from sofjax.calibration import UNKNOWNS, FitConfig, PairNoise
from sofjax.calibration.assessment import FitOutcome, ambiguity, assess, doubts
from sofjax.calibration.fit_drive import DriveFitConfig
from sofjax.calibration.floor_test import FloorTestConfig, lies_on_floor
from sofjax.calibration.tracks import TrackConfig

pytestmark = pytest.mark.usefixtures("x64")


@pytest.fixture
def mount():
    return true_mount()


@pytest.fixture
def pairs(camera, mount, rng):
    return make_pairs(camera, mount, rng)


def test_an_odometer_put_far_off_its_prior_widens_all_error_bars(camera, mount, rng):
    """The same drive, read right and read 30 % short in left turns, is known less by the ratio."""
    motion = np.stack(
        [rng.uniform(0.3, 0.9, N), rng.normal(0, 0.02, N), rng.uniform(0.1, 0.3, N)], axis=1
    )
    pairs = weighed(camera, mount, make_pairs(camera, mount, rng, motion, noise=0.3))
    short = eqx.tree_at(
        lambda p: p.T_first_second,
        pairs,
        jax.vmap(begin(camera, mount).moved(changes(left=-0.3)).motion)(pairs.T_first_second),
    )
    config = FitConfig(free=("height", "pitch", "roll", "left"))
    right, wrong = (fit_mount(camera, mount, p, config) for p in (pairs, short))
    assert float(right.birge_ratio) == 1 and doubts(right) == ""
    sigmas = float(wrong.odometer[1]) / config.prior_sigma[UNKNOWNS.index("left")]
    assert float(wrong.birge_ratio) == pytest.approx(abs(sigmas)) and sigmas > 5
    assert "clock or odometer" in doubts(wrong)
    ratio = np.sqrt(np.diag(wrong.covariance)[:3] / np.diag(right.covariance)[:3])
    np.testing.assert_allclose(ratio, sigmas, rtol=0.3)


def refusal(camera, mount, pairs):
    config = FitConfig()
    found = fit_mount(camera, mount, weighed(camera, mount, pairs), config)
    assessment = assess(found, config, pairs)
    assert not assessment.usable
    assert np.isfinite(found.covariance).all()
    return found, assessment


def test_a_pure_rotation_has_no_height(camera, mount, rng):
    centred = eqx.tree_at(lambda m: m.x, mount, jnp.zeros(()))
    motion = np.stack([np.zeros(N), np.zeros(N), rng.uniform(-0.25, 0.25, N)], axis=1)
    pairs = make_pairs(camera, centred, rng, motion, noise=0.3)
    found, refused = refusal(camera, centred, pairs)
    assert not bool(found.observable[0]) and int(np.abs(found.weakest).argmax()) == 0
    assert refused.outcome is FitOutcome.NOT_OBSERVABLE and "height" in refused.sentence


def test_lines_along_the_motion_have_no_height(camera, mount, rng):
    motion = np.stack([rng.uniform(0.3, 0.9, N), np.zeros(N), np.zeros(N)], axis=1)
    pairs = make_pairs(camera, mount, rng, motion, angle=np.zeros(N), noise=0.3)
    found, refused = refusal(camera, mount, pairs)
    assert not bool(found.observable[0]) and "height" in refused.sentence


def test_few_pairs_are_none(camera, mount, pairs):
    few = eqx.tree_at(lambda p: p.valid, pairs, jnp.arange(N) < 12)
    found, refused = refusal(camera, mount, few)
    assert refused.outcome is FitOutcome.TOO_FEW_PAIRS
    assert not found.observable.any() and "12 pairs" in refused.sentence
    found, refused = refusal(
        camera, mount, eqx.tree_at(lambda p: p.valid, pairs, jnp.zeros(N, bool))
    )
    assert "0 pairs" in refused.sentence and np.isfinite(value(found)).all()


def test_what_stands_above_the_floor_is_told_by_its_height(camera, mount, rng):
    z = np.where(np.arange(N) // 6 % 3 == 0, 0.1, 0.0)  # six pairs of each line
    pairs = weighed(camera, mount, make_pairs(camera, mount, rng, noise=0.3, z=z))
    line = jnp.arange(N) // 6
    floor = np.asarray(lies_on_floor(FloorTestConfig(), begin(camera, mount), pairs, line))
    assert floor[z == 0].mean() > 0.9 and floor[z > 0].mean() < 0.3
    wild = eqx.tree_at(
        lambda p: p.second, pairs, pairs.second + jnp.asarray(rng.normal(0, 15, (N, 2, 2)))
    )
    assert not np.asarray(lies_on_floor(FloorTestConfig(), begin(camera, mount), wild, line)).any()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: FitConfig(free=("pitch", "heigth")), "FitConfig.free must be some of height"),
        (lambda: FitConfig(min_pairs=0), "FitConfig.min_pairs must be a whole number from 1"),
        (lambda: FitConfig(limit=(0.05, 0.02)), "FitConfig.limit must be 17 numbers above 0"),
        (lambda: FitConfig(prior_sigma=(-1.0,) * 17), "FitConfig.prior_sigma must be 17 numbers"),
        (lambda: FloorTestConfig(max_rms=0.0), "FloorTestConfig.max_rms must be a number above 0"),
        (lambda: TrackConfig(max_lag=0), "TrackConfig.max_lag must be a whole number from 1"),
        (lambda: PairNoise(pixel_sigma=-0.5), "PairNoise.pixel_sigma must be a number from 0"),
        (lambda: DriveFitConfig(starts=()), "DriveFitConfig.starts must be one or more pairs"),
        (lambda: DriveFitConfig(capacity=0), "DriveFitConfig.capacity must be a whole number"),
    ],
)
def test_bad_settings_are_refused_by_name(make, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        make()


def test_starts_that_end_in_different_places_are_ambiguous():
    found = ambiguity(np.array([[0.6, 0.26, 0.02], [0.7, 0.26, 0.03]]))
    assert found.outcome is FitOutcome.AMBIGUOUS and not found.usable
    assert "from 2 starts" in found.sentence and "heights 0.600 to 0.700 m" in found.sentence
    assert "pitch" not in found.sentence and "roll 1.1 to 1.7°" in found.sentence
