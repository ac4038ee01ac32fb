"""Runs of the filter: as a scan, side by side, with the paper's settings, with odd input."""

import dataclasses
import functools
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import jit_quickly
from test_slam import (
    CAMERA,
    CONFIG,
    MOUNT,
    M,
    N,
    T,
    black,
    drive,
    frame,
    numbers,
    odometry,
    start,
    step,
    trajectory_error,
    with_sizes,
)

from sofjax import slam
from sofjax.extraction.observation import Observation
from sofjax.geometry import SE2, Segments, projection_matrix
from sofjax.segment_map import final_map
from sofjax.slam import SofSlam
from sofjax.slam.presets import PAPER


def assert_finite(tree):
    for leaf in numbers(tree):
        assert np.isfinite(leaf).all()


def test_a_wheel_that_spins_is_found_out():
    """The odometer reports a turn of 3 degrees that the robot never made.

    With the default number of particles: of few, none may try a slip of that size.
    """
    config = dataclasses.replace(
        CONFIG, filter=dataclasses.replace(CONFIG.filter, particles=slam.FilterConfig().particles)
    )
    true, observations = drive()
    spun = eqx.tree_at(
        lambda o: o.motion.yaw, observations, observations.motion.yaw.at[T // 2].add(np.radians(3))
    )
    state = SofSlam(config, CAMERA, MOUNT).init(jax.random.key(0), M)
    _, infos = SofSlam(config, CAMERA, MOUNT).run(state, spun)
    error = np.degrees(np.asarray(infos.T_world_robot.yaw) - true[:, 2])
    assert abs(error[T // 2 + 3 :]).max() < 0.6
    assert trajectory_error(infos.T_world_robot.xy) < 0.02


def test_edges_of_doors_are_never_born():
    """From one image to the next an upright edge moves as a line of the floor may."""
    doors = np.array([[1.6, 0.8], [2.2, -0.9], [3.0, 1.1], [3.4, -0.3]])
    edges = np.stack([np.insert(doors, 2, 0.0, axis=1), np.insert(doors, 2, 0.5, axis=1)], axis=1)
    rng = np.random.default_rng(2)
    state, info = start(), None
    for i in range(12):
        pose = [0.08 * i, 0.01 * i, 0.01 * i]
        T = SE2(jnp.asarray(pose[:2], float), jnp.asarray(pose[2], float))
        x = np.insert(edges, 3, 1.0, axis=2) @ np.asarray(projection_matrix(CAMERA, MOUNT, T)).T
        seen = x[..., :2] / x[..., 2:] + rng.normal(0, 0.2, (len(doors), 2, 2))
        ends = jnp.zeros((M, 2, 2)).at[: len(doors)].set(seen)
        motion = SE2(jnp.array([0.08, 0.01]), jnp.array(0.01, float)) if i else SE2.identity()
        segments = Segments(ends, jnp.arange(M) < len(doors))
        observation = Observation(segments, motion, jnp.zeros((), int))
        state, info = step(SofSlam(CONFIG, CAMERA, MOUNT), state, observation)
        assert info.below_horizon >= 3
    assert not state.segment_map.valid.any()


def test_a_scan_is_one_step_after_the_other():
    """In float64: the compiler rounds a loop's body otherwise, and resampling magnifies that."""
    # indices of top_k stay int32
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        as_float64 = functools.partial(
            jax.tree.map, lambda a: a.astype(float) if a.dtype == "float32" else a
        )
        camera, mount, observations = as_float64((CAMERA, MOUNT, drive()[1]))
        one_step, scan = (jit_quickly(f.__wrapped__) for f in (SofSlam.step, SofSlam.run))
        one = state = SofSlam(CONFIG, camera, mount).init(jax.random.key(0), M)
        scanned_state, scanned = scan(SofSlam(CONFIG, camera, mount), state, observations)
        for i in range(T):
            observation = jax.tree.map(operator.itemgetter(i), observations)
            one, info = one_step(SofSlam(CONFIG, camera, mount), one, observation)
            for a, b in zip(numbers(scanned), numbers(info), strict=True):
                np.testing.assert_allclose(a[i], b, rtol=1e-6, atol=1e-9)
        for a, b in zip(numbers(scanned_state), numbers(one), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9)


def test_the_state_keeps_its_types_from_the_first_step_on():
    """Or the second image would be compiled anew."""
    before = start()
    after, _ = jax.eval_shape(SofSlam(CONFIG, CAMERA, MOUNT).step, before, frame(0))
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        assert getattr(a, "weak_type", False) == b.weak_type


def image(*ends):
    padded = np.zeros((M, 2, 2))
    padded[: len(ends)] = np.asarray(ends, float).reshape(-1, 2, 2)
    return Segments(jnp.asarray(padded, "float32"), jnp.arange(M) < len(ends))


HORIZON = 119.5 - 270 * np.tan(0.2618)


DEGENERATE = {
    "none": image(),
    "without length": image(*[[[160, 200], [160, 200]]] * 3),
    "all the same": image(*[[[60, 200], [260, 205]]] * M),
    "above the horizon": image([[10, 5], [300, 9]]),
    "on the horizon": image([[10, HORIZON], [300, HORIZON]]),
    "across the horizon": image([[10, 200], [300, 5]], [[160, 239], [160, 0]]),
    "far out of the image": image([[-1e6, 1e6], [1e6, 2e6]], [[1e6, 200], [2e6, 200]]),
    "tiny": image([[160, 200], [160.001, 200]]),
    "through the principal point": image([[159.5, 119.5], [159.5, 200]]),
    "full": image(*np.random.default_rng(0).uniform([0, 0], [320, 240], size=(M, 2, 2))),
}


MOTIONS = {
    "no motion": (0.0, 0.0, 0.0),
    "a step": (0.2, 0.0, 0.0),
    "on the spot": (0.0, 0.0, 1.0),
    "half a turn": (0.0, 0.0, np.pi),
    "a leap backwards": (-50.0, 3.0, -3.0),
}


@pytest.mark.parametrize("segments", DEGENERATE.values(), ids=DEGENERATE)
def test_no_input_makes_a_number_that_is_none(segments):
    state = start()
    for motion in MOTIONS.values():
        x, y, yaw = motion
        observation = Observation(
            segments, SE2(jnp.array([x, y], float), jnp.array(yaw, float)), jnp.zeros((), int)
        )
        for _ in range(2):
            state, info = step(SofSlam(CONFIG, CAMERA, MOUNT), state, observation)
            assert_finite((state, info))


def test_the_paper_s_settings_run_with_a_single_winner():
    config = with_sizes(PAPER)
    paper = jit_quickly(eqx.debug.assert_max_traces(SofSlam.step.__wrapped__, max_traces=1))
    state, errors = start(config), []
    for i in range(T):
        state, info = paper(SofSlam(config, CAMERA, MOUNT), state, frame(i))
        assert_finite((state, info))
        # the next particles are all drawn from the one that was chosen
        np.testing.assert_array_equal(
            state.particles.T_world_robot.xy,
            jnp.broadcast_to(state.particles.T_world_robot.xy[0], (N, 2)),
        )
        np.testing.assert_allclose(
            state.particles.T_world_robot.xy[0], info.T_world_robot.xy, atol=1e-5
        )
        errors.append(np.linalg.norm(info.T_world_robot.xy - drive()[0][i, :2]))
    assert state.segment_map.valid.sum() > 5
    np.testing.assert_array_equal(state.segment_map.line[:, 2], 1)  # no heights
    np.testing.assert_array_equal(state.particles.bias.mean, 0)  # no systematic errors
    by_odometer = trajectory_error(odometry(drive()[1].motion)[:, :2])
    assert np.sqrt(np.mean(np.square(errors))) < by_odometer


def test_the_final_map_worked_by_hand():
    """Seen often, in most images that should show it, of known height, and on the floor."""
    rules = CONFIG.segment_map
    cases = [  # the apparent scale, its sigma, updates, expected, valid -> of the map
        (1.0, 0.01, 20, 20, True, True),
        (1.0, 0.01, rules.min_updates - 1, 4, True, False),
        (1.0, 0.01, 20, 200, True, False),  # a tenth of the images that should have shown it
        (1.2, 0.01, 20, 20, True, False),  # the top of a baseboard
        (1.0, 0.20, 20, 20, True, False),  # who knows
        (1.0, 0.01, 20, 20, False, False),
    ]
    apparent_scale, sigma, updates, expected, valid, of_the_map = map(
        np.array, zip(*cases, strict=True)
    )
    n = len(cases)
    empty = start().segment_map
    m = dataclasses.replace(
        empty,
        segments_world=Segments(empty.segments_world.endpoints, empty.valid.at[:n].set(valid)),
        line=empty.line.at[:n, 2].set(apparent_scale),
        covariance=empty.covariance.at[:n, 2, 2].set(sigma**2),
        updates=empty.updates.at[:n].set(updates),
        expected=empty.expected.at[:n].set(expected),
    )
    found = final_map(CONFIG.segment_map, MOUNT, m)
    np.testing.assert_array_equal(found.is_floor[:n], of_the_map)
    assert not found.is_floor[n:].any()
    np.testing.assert_allclose(found.height[3], 0.6 - 0.6 / 1.2, rtol=1e-5)
    np.testing.assert_allclose(found.height_sigma[:n], 0.6 * sigma / apparent_scale**2, rtol=1e-4)


def test_runs_side_by_side_are_the_runs_one_by_one():
    """Seeds, settings, mounts and drives of one length under vmap; float64 as above."""
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        as_float64 = functools.partial(
            jax.tree.map, lambda a: a.astype(float) if a.dtype == "float32" else a
        )
        camera, mount, log = as_float64((CAMERA, MOUNT, drive()[1]))
        logs = [jax.tree.map(lambda a, i=i: a[i : i + 14], log) for i in (0, 5)]
        several = [  # pixel_sigma, height, key, drive
            (jnp.array(0.5), jnp.array(0.6), jax.random.key(0), logs[0]),
            (jnp.array(0.8), jnp.array(0.62), jax.random.key(1), logs[1]),
        ]

        def run(pixel_sigma, height, key, log):
            config = eqx.tree_at(lambda c: c.sensor.pixel_sigma, CONFIG, pixel_sigma)
            at = eqx.tree_at(lambda m: m.height, mount, height)
            return SofSlam(config, camera, at).run(SofSlam(config, camera, at).init(key, M), log)

        stacked = jax.tree.map(lambda *a: jnp.stack(a), *several)
        together, alone = jit_quickly(jax.vmap(run))(*stacked), jit_quickly(run)
        for i, each in enumerate(several):
            one = jax.tree.map(operator.itemgetter(i), together)
            for a, b in zip(numbers(one), numbers(alone(*each)), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9)


def test_what_the_odometer_does_not_tell_spreads_the_particles():
    state = start()
    sigma = jnp.array([0.3, 0.1, 0.2])
    still = dataclasses.replace(black(SE2.identity()), motion_sigma=sigma)
    known = dataclasses.replace(still, motion_sigma=jnp.zeros(3))
    step = jit_quickly(SofSlam.step.__wrapped__)
    spread, _ = step(SofSlam(CONFIG, CAMERA, MOUNT), state, still)
    twist = np.asarray(spread.particles.T_world_robot.log())
    np.testing.assert_allclose(twist.std(axis=0), sigma, rtol=0.35)
    assert (np.asarray(spread.particles.bias.mean) == 0).all()  # it is no error of the odometer
    same, _ = step(SofSlam(CONFIG, CAMERA, MOUNT), state, known)
    assert (np.asarray(same.particles.T_world_robot.xy) == 0).all()
