"""Extracting SoF; Fig. 5."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from conftest import jit_quickly

from sofjax.extraction.association import Association
from sofjax.extraction.sof import below_horizon, extract, put_on_floor
from sofjax.geometry import SE2, Mount, Segments

pytestmark = pytest.mark.usefixtures("x64")

TILES = [[[x, -0.6], [x, 0.6]] for x in (1.4, 1.9, 2.5)] + [
    [[1.2, y], [3, y]] for y in (-0.7, 0.3, 0.9)
]
CONFIG = Association(gate=2.0)
sof = jit_quickly(extract)


def at_height(z):
    return np.concatenate([TILES, np.full((len(TILES), 2, 1), z)], axis=2)


def view(camera, mount, pose, ends, capacity=16):
    seen = reference.look(camera, mount, pose, ends)
    padded = np.zeros((capacity, 2, 2))
    padded[: len(seen)] = seen
    return Segments(jnp.asarray(padded), jnp.arange(capacity) < len(seen))


def pose(x, y, yaw):
    return SE2(jnp.array([x, y], float), jnp.array(yaw, float))


def test_segments_of_the_floor_are_found_where_they_are(camera, mount):
    where = (0.4, 0.05, 0.1)
    first, second = (view(camera, mount, p, TILES) for p in ((0, 0, 0), where))
    found = sof(CONFIG, camera, mount, first, second, pose(*where))
    assert found.is_floor.sum() == second.valid.sum() == len(TILES)
    in_world = pose(*where).apply(found.segments_robot.endpoints[: len(TILES)])
    for segment, true in zip(np.asarray(in_world), np.array(TILES), strict=True):
        direction = (true[1] - true[0]) / np.linalg.norm(true[1] - true[0])
        across = np.array([-direction[1], direction[0]])
        np.testing.assert_allclose((segment - true[0]) @ across, 0, atol=1e-6)


def test_the_same_lines_over_the_floor_are_not_found(camera, mount):
    first, second = (view(camera, mount, (x, 0, 0), at_height(0.15)) for x in (0, 0.6))
    found = sof(CONFIG, camera, mount, first, second, pose(0.6, 0, 0))
    assert found.segments_robot.valid.sum() == len(TILES)  # below the horizon all the same
    assert not found.is_floor[:3].any()


def test_a_pair_of_the_floor_that_is_too_far_away_is_not_used(camera, mount):
    first, second = (view(camera, mount, (x, 0, 0), TILES) for x in (0, 0.4))
    found = sof(CONFIG, camera, mount, first, second, pose(0.4, 0, 0), 1.8)
    assert found.matches.matched.sum() == len(TILES)
    assert 0 < found.is_floor.sum() < len(TILES)
    np.testing.assert_array_equal(found.is_floor, found.segments_robot.valid)


def test_a_wrong_motion_finds_none(camera, mount):
    first, second = (view(camera, mount, p, TILES) for p in ((0, 0, 0), (0.4, 0, 0)))
    found = sof(Association(gate=1.0), camera, mount, first, second, pose(0.4, 0, 0.2))
    assert not found.is_floor.any()


def test_extract_for_many_poses_is_the_loop_over_poses(camera, mount, rng):
    first, second = (view(camera, mount, p, TILES) for p in ((0, 0, 0), (0.4, 0.05, 0.1)))
    xy, yaw = rng.normal([0.4, 0.05], 0.02, size=(12, 2)), rng.normal(0.1, 0.02, size=12)
    many = SE2(jnp.asarray(xy), jnp.asarray(yaw))

    def of_pose(T):
        return extract(CONFIG, camera, mount, first, second, T)

    batch = jit_quickly(jax.vmap(of_pose))(many)
    assert 0 < batch.is_floor.sum() < batch.is_floor.size
    for i in range(12):
        alone = sof(CONFIG, camera, mount, first, second, pose(*xy[i], yaw[i]))
        np.testing.assert_array_equal(batch.is_floor[i], alone.is_floor)
        np.testing.assert_array_equal(batch.matches.partner[i], alone.matches.partner)
        np.testing.assert_allclose(
            batch.matches.error[i], alone.matches.error, rtol=1e-6, atol=1e-8
        )
        np.testing.assert_allclose(
            batch.segments_robot.endpoints[i], alone.segments_robot.endpoints
        )


def test_padding_is_never_floor_and_always_finite(camera, mount):
    padding = Segments(jnp.zeros((16, 2, 2)), jnp.zeros(16, bool))
    # padding that would make a fine floor segment, were it valid
    tempting = Segments(
        jnp.broadcast_to(jnp.array([[80.0, 200.0], [240.0, 210.0]]), (16, 2, 2)), padding.valid
    )
    for first in (padding, tempting):
        for second in (padding, tempting):
            found = sof(CONFIG, camera, mount, first, second, pose(0, 0, 0))
            assert not found.is_floor.any() and not found.segments_robot.valid.any()
            assert jnp.isfinite(found.segments_robot.endpoints).all()


def test_what_is_too_far_is_cut_at_the_greatest_depth(camera):
    level = Mount.create(height=1.0)
    along = Segments(jnp.array([[[159.5, 230.0], [159.5, 120.0]]]), jnp.array([True]))
    found = put_on_floor(camera, level, along, 6.0)
    np.testing.assert_allclose(found.endpoints[0, 1], [6, 0], atol=1e-9)
    assert found.valid[0]


def test_a_segment_is_below_the_horizon_if_both_its_ends_are(camera):
    level = Mount.create(height=1.0)  # horizon at row 119.5
    rows = [(130, 200), (110, 200), (200, 110), (30, 40), (119, 200)]
    ends = jnp.array([[[50, a], [250, b]] for a, b in rows], float)
    found = below_horizon(camera, level, Segments(ends, jnp.ones(5, bool)))
    np.testing.assert_array_equal(found.valid, [True, False, False, False, False])
