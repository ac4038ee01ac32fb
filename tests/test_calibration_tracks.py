"""Lines followed from image to image, and the pairs made of them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from line_pairs import FIT, begin, fit_mount, off, seen, true_mount, value

from sofjax.calibration.tracks import TrackConfig, follow, relate
from sofjax.extraction.observation import Observation
from sofjax.geometry import SE2, Segments
from sofjax.motion import without_unread_motions

pytestmark = pytest.mark.usefixtures("x64")


@pytest.fixture
def mount():
    return true_mount()


@pytest.fixture
def log(camera, mount, rng):
    """Forty images on a straight path over twelve lines, slightly noisy; one is missed once."""
    ends = np.zeros((12, 2, 3))
    angle = np.linspace(0.3, 2.8, 12)
    along = 0.3 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    middle = np.stack([np.linspace(3, 5, 12), np.linspace(-0.7, 0.7, 12)], axis=1)
    ends[..., :2] = np.stack([middle - along, middle + along], axis=1)
    images = [seen(camera, mount, (0.05 * i, 0.0, 0.0), ends) for i in range(40)]
    endpoints = np.zeros((40, 16, 2, 2))
    order = np.stack([rng.permutation(12) for _ in range(40)])
    endpoints[:, :12] = np.stack([image[p] for image, p in zip(images, order, strict=True)])
    endpoints[:, :12] += rng.normal(0, 0.2, (40, 12, 2, 2))
    valid = np.broadcast_to(np.arange(16) < 12, (40, 16)).copy()
    valid[20, np.flatnonzero(order[20] == 5)] = False
    motion = SE2(jnp.tile(jnp.array([[0.05, 0.0]]), (40, 1)).at[0].set(0), jnp.zeros(40))
    log = Observation(
        Segments(jnp.asarray(endpoints), jnp.asarray(valid)), motion, jnp.zeros(40, int)
    )
    return log, order


def test_lines_are_followed_though_missed_once_and_the_mount_is_rough(camera, mount, log):
    log, order = log
    track = follow(TrackConfig(), begin(camera, off(mount, 1.25, 0.1)), log)
    assert (track[:, 12:] == -1).all() and (track[20] == -1).sum() == 5
    of_line = np.where(track[:, :12] >= 0, track[:, :12], 0)
    for t in range(1, 40):
        for m in range(12):
            before = int(np.flatnonzero(order[t - 1] == order[t, m])[0])
            if track[t, m] >= 0 and track[t - 1, before] >= 0:
                assert of_line[t, m] == of_line[t - 1, before]
    gap = [track[t, np.flatnonzero(order[t] == 5)[0]] for t in (19, 21)]
    assert gap[0] == gap[1] >= 0


def test_nothing_is_followed_over_a_motion_that_nobody_read(camera, mount, log):
    log, _ = log
    config = TrackConfig()
    unread = dataclasses.replace(log, motion_sigma=jnp.zeros((40, 3)).at[20].set(0.1))
    track = follow(config, begin(camera, mount), unread)
    before, behind = (np.unique(part[part >= 0]) for part in (track[:20], track[20:]))
    assert len(before) == 12 and not np.intersect1d(before, behind).size
    known = without_unread_motions(log)
    assert known is log
    xy = log.motion.xy.at[20, 0].set(jnp.nan)
    nan = dataclasses.replace(log, motion=SE2(xy, log.motion.yaw))
    known = without_unread_motions(nan)
    assert (np.flatnonzero(np.asarray(known.motion_sigma).any(axis=1)) == [20]).all()
    assert np.isfinite(known.motion.xy).all()
    np.testing.assert_array_equal(known.motion.xy[:20], log.motion.xy[:20])


def test_pairs_are_nested_and_use_each_segment_once(camera, mount, log):
    log, _ = log
    track = follow(TrackConfig(), begin(camera, mount), log)
    pairs, line = relate(TrackConfig(), log, track, 0.6, 256)
    valid = np.asarray(pairs.valid)
    assert valid.sum() > 60 and len(np.unique(np.asarray(line)[valid])) == 12
    path = np.asarray(pairs.T_first_second.xy)[valid, 0]
    assert path.min() >= 0.3 - 1e-9 and path.max() <= 1.2 + 1e-9
    used = np.concatenate([np.asarray(pairs.first)[valid], np.asarray(pairs.second)[valid]])
    assert len(np.unique(used.reshape(-1, 4), axis=0)) == len(used)
    assert (np.asarray(line)[~valid] == -1).all()
    few, _ = relate(TrackConfig(), log, track, 0.6, 32)
    assert np.asarray(few.valid).all() and len(few.valid) == 32
    found = fit_mount(camera, off(mount, 1.2, 0.08), pairs)
    np.testing.assert_allclose(value(found), list(FIT.values()), atol=0.01)
