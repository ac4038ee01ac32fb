"""Fig. 6 as one step: the same as a scan, compiled once, and better than the odometer."""

import dataclasses
import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from conftest import jit_quickly, make_camera

from sofjax.extraction.observation import Observation
from sofjax.extraction.sof import View
from sofjax.geometry import SE2, Mount, Segments
from sofjax.motion import MotionModel
from sofjax.particles import effective_size, mean_pose
from sofjax.segment_map import final_map
from sofjax.slam import SofSlam
from sofjax.slam.advance import LOST_AFTER
from sofjax.slam.presets import DEFAULT

T, M, N, K = 40, 32, 64, 96


def with_sizes(config):
    return dataclasses.replace(
        config,
        filter=dataclasses.replace(config.filter, particles=N),
        segment_map=dataclasses.replace(config.segment_map, capacity=K),
    )


CONFIG = with_sizes(DEFAULT)
MOUNT = Mount.create(height=0.6, pitch=0.2618, x=0.05)
CAMERA = make_camera()

# one trace for all the images, keys and numbers of every test below
step = jit_quickly(eqx.debug.assert_max_traces(SofSlam.step.__wrapped__, max_traces=1))


def tiles():
    """A floor of tiles, 60 cm by 90 cm, whose long lines come in pieces."""
    along = [[[x, y], [x + 2.6, y]] for x in (-1, 1.8, 4.6) for y in (-1.2, -0.6, 0, 0.6, 1.2)]
    across = [[[0.9 * i, -1.2], [0.9 * i, 1.2]] for i in range(8)]
    return np.array(along + across)


@functools.cache
def drive():
    """True poses, what an odometer with systematic errors reads, and what the camera sees."""
    rng = np.random.default_rng(7)
    twists = np.column_stack([np.full(T, 0.08), np.zeros(T), 0.04 * np.sin(np.arange(T) / 6)])
    twists[0] = 0
    true = [np.eye(3)]
    read = twists * [1.03, 1, 1.08] + twists[:, :1] * [0, 0, 0.015]
    read = read + rng.normal(size=(T, 3)) * [0.001, 0, 0.0005] * (twists[:, :1] > 0)
    ends = np.zeros((T, M, 2, 2))
    counts = np.zeros(T, int)
    for i in range(T):
        if i:
            arc = SE2.exp(jnp.asarray(twists[i]))
            true.append(true[-1] @ reference.pose_matrix([*arc.xy, arc.yaw]))
        seen = reference.look(CAMERA, MOUNT, reference.pose_of(true[-1]), tiles())[:M]
        counts[i] = len(seen)
        ends[i, : len(seen)] = seen + rng.normal(0, 0.3, size=seen.shape)
    segments = Segments(jnp.asarray(ends, "float32"), jnp.arange(M) < jnp.asarray(counts)[:, None])
    motion = SE2.exp(jnp.asarray(read, "float32"))
    return np.array([reference.pose_of(m) for m in true]), Observation(
        segments, motion, jnp.zeros(T, "int32")
    )


def frame(i):
    return jax.tree.map(lambda a: a[i], drive()[1])


def black(motion):
    return Observation(
        Segments(jnp.zeros((M, 2, 2)), jnp.zeros(M, bool)), motion, jnp.zeros((), int)
    )


def start(config=CONFIG, seed=0):
    return SofSlam(config, CAMERA, MOUNT).init(jax.random.key(seed), M)


def stepped(observations, config=CONFIG, seed=0, state=None):
    state, infos = start(config, seed) if state is None else state, []
    for observation in observations:
        state, info = step(SofSlam(config, CAMERA, MOUNT), state, observation)
        infos.append(info)
    return state, jax.tree.map(lambda *a: jnp.stack(a), *infos)


@functools.cache
def default_run(seed=0):
    return stepped(map(frame, range(T)), seed=seed)


def odometry(motions):
    poses, matrix = [], np.eye(3)
    for xy, yaw in zip(np.asarray(motions.xy), np.asarray(motions.yaw), strict=True):
        matrix = matrix @ reference.pose_matrix([*xy, yaw])
        poses.append(reference.pose_of(matrix))
    return np.array(poses)


def trajectory_error(xy):
    return float(np.sqrt(np.mean(np.sum((np.asarray(xy) - drive()[0][:, :2]) ** 2, axis=1))))


def numbers(tree):
    return [
        np.asarray(
            jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        )
        for leaf in jax.tree.leaves(tree)
    ]


def assert_bitwise_equal(a, b):
    for x, y in zip(numbers(a), numbers(b), strict=True):
        np.testing.assert_array_equal(x, y)


def test_a_short_drive_ends_nearer_to_the_truth_than_its_odometer():
    _, info = default_run()
    by_odometer = trajectory_error(odometry(drive()[1].motion)[:, :2])
    assert by_odometer > 0.05
    assert trajectory_error(info.T_world_robot.xy) < 0.3 * by_odometer
    yaw = np.asarray(info.T_world_robot.yaw) - drive()[0][:, 2]
    assert np.abs(yaw).max() < 0.01
    assert not info.lost.any()


def test_the_map_of_a_short_drive_lies_on_the_floor_s_lines():
    state, _ = default_run()
    found = final_map(CONFIG.segment_map, MOUNT, state.segment_map)
    assert found.is_floor.sum() > 8
    for ends in np.asarray(found.endpoints_world)[np.asarray(found.is_floor)]:
        distances = []
        for a, b in tiles():
            d = (b - a) / np.linalg.norm(b - a)
            distances.append(np.abs((ends - a) @ [-d[1], d[0]]).max())
        assert min(distances) < 0.04


def test_the_odometer_s_distance_error_is_learned():
    """It reads 3 % too much: the motion is what was read divided by 1.03."""
    _, info = default_run()
    assert info.bias[-1, 0] == pytest.approx(1 / 1.03 - 1, abs=0.012)


@functools.cache
def down_a_corridor(seed):
    """20 m in a corridor without a line across."""
    rng = np.random.default_rng(seed)
    walls = np.array([[[-5, y], [60, y]] for y in (-1.2, -0.7, 0.5, 1.1)])
    forward = SE2(jnp.array([0.2, 0]), jnp.zeros(()))

    def observation(i):
        seen = reference.look(CAMERA, MOUNT, [0.2 * i, 0, 0], walls)
        ends = jnp.zeros((M, 2, 2)).at[: len(seen)].set(seen + rng.normal(0, 0.3, seen.shape))
        motion = forward if i else SE2.identity()
        return Observation(Segments(ends, jnp.arange(M) < len(seen)), motion, jnp.zeros((), int))

    return stepped(map(observation, range(101)))[1]


def test_where_all_lines_run_along_the_way_the_distance_is_the_odometer_s_and_as_unsure():
    """The spread is that of the odometer's scale, 1 %."""
    info = down_a_corridor(3)
    assert (info.matched[20:] >= 3).mean() > 0.95 and not info.across.any()  # some lines rest
    x, sigma = info.T_world_robot.xy[-1, 0], info.covariance[-1, 0, 0] ** 0.5
    assert x == pytest.approx(20, abs=0.06)
    assert sigma == pytest.approx(0.2, rel=0.3)
    assert info.covariance[-1, 1, 1] ** 0.5 < 0.01


def test_where_all_lines_run_along_the_way_the_place_across_it_is_known():
    """Of one drive it hangs on the chance of its first images: the map is as it began."""
    sideways = [abs(down_a_corridor(seed).T_world_robot.xy[:, 1]).max() for seed in range(9)]
    assert np.median(sideways) < 0.02


def test_other_numbers_in_the_settings_are_not_compiled_anew():
    """`step` may be traced once in this file; sizes and kinds are static, numbers are not."""
    sensor = dataclasses.replace(CONFIG.sensor, pixel_sigma=0.7)
    rules = dataclasses.replace(CONFIG.segment_map, range=4.0)
    stepped([frame(0)], dataclasses.replace(CONFIG, sensor=sensor, segment_map=rules))


def test_the_same_key_gives_the_same_run_bit_for_bit():
    first, again = (stepped(map(frame, range(6)), seed=3) for _ in range(2))
    assert_bitwise_equal(first, again)


def test_another_key_gives_another_run():
    first, other = (stepped(map(frame, range(6)), seed=seed)[0].particles for seed in (3, 4))
    assert (np.asarray(first.T_world_robot.xy) != np.asarray(other.T_world_robot.xy)).all()


def test_the_first_image_begins_no_lines_and_a_baseline_later_some_are_known():
    _, info = default_run()
    assert info.initialised[0] == info.associated[0] == info.matched[0] == 0
    assert info.associated[4:].min() > 0
    assert info.matched[6:].min() > 0


@pytest.mark.parametrize("used", ["recent", "reference"])
def test_an_image_is_compared_with_the_last_view_a_baseline_away(used):
    """The recent one if it is far enough, else the one before; here the other one is black."""
    state, info = stepped(map(frame, range(12)))

    def view(i, segments):
        T = SE2(info.T_world_robot.xy[i], info.T_world_robot.yaw[i])
        return View(segments, T, T)

    nothing = black(SE2.identity()).segments_image
    views = {
        "recent": {"recent": view(7, frame(7).segments_image), "reference": view(0, nothing)},
        "reference": {"recent": view(11, nothing), "reference": view(7, frame(7).segments_image)},
    }
    _, after = stepped([frame(12)], state=dataclasses.replace(state, **views[used]))
    assert after.associated[0] > 3


def test_the_funnel_narrows():
    _, info = default_run()
    np.testing.assert_array_equal(info.detected, drive()[1].segments_image.valid.sum(axis=1))
    for wide, narrow in (
        (info.detected, info.below_horizon),
        (info.below_horizon, info.associated),
        (info.below_horizon, info.matched + info.initialised),
    ):
        assert (wide >= narrow).all()
    counts = (np.asarray(info.segment_class)[..., None] >= [1, 2, 3]).sum(axis=1)
    np.testing.assert_array_equal(counts[:, 0], info.detected)
    np.testing.assert_array_equal(counts[:, 1], info.below_horizon)
    assert (counts[:, 2] >= info.matched + info.initialised).all()


def test_the_map_counts_what_was_born():
    state, info = default_run()
    assert 0 < state.segment_map.valid.sum() <= info.initialised.sum()


def test_black_images_leave_the_map_as_it_is_and_follow_the_odometer():
    silent = MotionModel(*[0.0] * 11)
    config = dataclasses.replace(CONFIG, motion=silent)
    state, _ = stepped(map(frame, range(8)), config)
    motions = jax.tree.map(lambda a: a[8:20], drive()[1].motion)
    dark = [black(SE2(xy, yaw)) for xy, yaw in zip(motions.xy, motions.yaw, strict=True)]
    after, info = stepped(dark, config, state=state)
    assert_bitwise_equal(after.segment_map, state.segment_map)
    begin = mean_pose(state.particles)
    here = reference.pose_matrix([*begin.xy, begin.yaw])
    expected = [reference.pose_of(here @ reference.pose_matrix(p)) for p in odometry(motions)]
    np.testing.assert_allclose(info.T_world_robot.xy, np.array(expected)[:, :2], atol=1e-5)
    np.testing.assert_allclose(info.T_world_robot.yaw, np.array(expected)[:, 2], atol=1e-5)


def test_black_images_with_a_noisy_odometer_are_followed_in_the_mean():
    state, _ = default_run()
    dark = [black(SE2(jnp.array([0.1, 0.0]), jnp.array(0.0, float)))] * 12
    after, info = stepped(dark, state=state)
    assert_bitwise_equal(after.segment_map, state.segment_map)
    way = np.linalg.norm(np.asarray(info.T_world_robot.xy[-1] - info.T_world_robot.xy[0]))
    assert way == pytest.approx(1.1 * (1 + float(info.bias[0, 0])), abs=0.01)
    np.testing.assert_array_equal(info.lost, np.arange(12) >= LOST_AFTER - 1)
    spread = after.particles.T_world_robot.xy.std(axis=0)
    assert (spread > state.particles.T_world_robot.xy.std(axis=0)).all()


def test_after_the_dark_the_drive_goes_on():
    state, _ = stepped(map(frame, range(20)))
    motions = jax.tree.map(lambda a: a[20:26], drive()[1].motion)
    dark = [black(SE2(xy, yaw)) for xy, yaw in zip(motions.xy, motions.yaw, strict=True)]
    state, _ = stepped(dark, state=state)
    _, info = stepped(map(frame, range(26, T)), state=state)
    assert not info.lost.any()
    error = np.asarray(info.T_world_robot.xy) - drive()[0][26:, :2]
    assert np.abs(error).max() < 0.05


def test_a_sensor_that_stays_inconsistent_leaves_it_to_the_odometer():
    state, _ = stepped(map(frame, range(20)))
    before = effective_size(state.particles.log_weight)
    size = {}
    for noise in (1.0, CONFIG.sensor.noise_max):
        doubted = eqx.tree_at(
            lambda s: s.variance_inflation,
            state,
            jnp.asarray(noise, state.variance_inflation.dtype),
        )
        _, info = step(SofSlam(CONFIG, CAMERA, MOUNT), doubted, frame(20))
        size[noise] = float(info.effective_size)
        assert info.matched > 0  # so that it can be trusted again
    assert size[1.0] < 0.7 * before < 0.95 * before < size[CONFIG.sensor.noise_max]


def test_the_weights_stay_normalised():
    state, info = default_run()
    assert jax.nn.logsumexp(state.particles.log_weight) == pytest.approx(0, abs=1e-4)
    assert (info.effective_size >= 1 - 1e-3).all() and (info.effective_size <= N + 1e-2).all()


# The final map


def test_a_motion_that_is_not_a_number_is_an_unknown_one():
    """The path goes on, and the map finds the robot again."""
    unread = [frame(i) for i in range(T)]
    for i in (12, 25):
        nan = SE2(unread[i].motion.xy * jnp.nan, unread[i].motion.yaw)
        unread[i] = dataclasses.replace(unread[i], motion=nan)
    _, infos = stepped(unread)
    for leaf in jax.tree.leaves(infos):
        assert not np.isnan(leaf).any()
    _, usual = default_run()
    assert (
        trajectory_error(infos.T_world_robot.xy) < trajectory_error(usual.T_world_robot.xy) + 0.05
    )


def test_the_counts_of_a_step_narrow_down():
    _, infos = default_run()
    counts = [infos.detected, infos.below_horizon, infos.associated, infos.reobserved]
    assert all((a >= b).all() for a, b in itertools.pairwise(map(np.asarray, counts)))
    assert int(infos.reobserved.sum()) > 100
    assert (np.asarray(infos.reobserved) <= np.asarray(infos.matched)).all()
