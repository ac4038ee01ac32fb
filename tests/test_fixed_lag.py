"""Smoothing of the last keyframes while driving."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from conftest import jit_quickly
from test_slam import CAMERA, CONFIG, MOUNT, black, drive, start

from sofjax.geometry import SE2, Segments
from sofjax.likelihood.measurements import measure
from sofjax.motion import MotionModel, OdometerBias
from sofjax.segment_map import empty_map
from sofjax.slam import FixedLagConfig, SofSlam
from sofjax.slam.bundle import BIAS, POSE, Linear, gauss_newton
from sofjax.slam.fixed_lag import Image, Mapped, slide
from sofjax.slam.keyframes import Known, empty_window

J, M = 6, 16
OPEN = dataclasses.replace(CONFIG, window=FixedLagConfig(keyframes=8, lines=32))


@pytest.mark.usefixtures("x64")
def test_a_step_is_that_of_the_dense_least_squares(rng):
    W, n = 4, 4 * POSE + BIAS
    symmetric = lambda *shape: (lambda a: a @ np.swapaxes(a, -1, -2))(rng.normal(size=shape))
    given = (
        rng.integers(J, size=(W, M)), np.ones((W, M), bool), rng.normal(size=(W, M, 2)),
        rng.normal(size=(W, M, 2, POSE)), rng.normal(size=(W, M, 2, 3)), symmetric(W, M, 2, 2),
    )  # fmt: skip
    linear = Linear(*map(jnp.asarray, given), J)
    known = Known(*map(jnp.asarray, (rng.normal(size=(J, 3)), symmetric(J, 3, 3))))
    line = jnp.asarray(rng.normal(size=(J, 3)))
    floor = np.array([0, 50.0] * (J // 2))
    R, r = rng.normal(size=(3 * n, n)), rng.normal(size=3 * n)
    held = np.arange(n) < POSE
    x, after = gauss_newton(
        linear, known, jnp.asarray(floor), lambda x: R @ x + r, jnp.asarray(held), line
    )

    # every residual as rows over all poses, the odometer's errors, and all lines
    rows, right = [np.hstack([R, np.zeros((3 * n, 3 * J))])], [-r]
    for w, m in np.ndindex(W, M):
        row, k = np.zeros((2, n + 3 * J)), n + 3 * linear.line[w, m]
        row[:, POSE * w : POSE * (w + 1)] = linear.by_pose[w, m]
        row[:, k : k + 3] = linear.by_line[w, m]
        root = np.linalg.cholesky(linear.weight[w, m]).T
        rows.append(root @ row)
        right.append(root @ linear.error[w, m])
    for k in range(J):
        row = np.zeros((4, n + 3 * J))
        root = np.linalg.cholesky(known.information[k]).T
        row[:3, n + 3 * k : n + 3 * k + 3] = root
        row[3, n + 3 * k + 2] = np.sqrt(floor[k])
        rows.append(row)
        off = root @ (known.line[k] - line[k])
        right.append(np.append(off, np.sqrt(floor[k]) * (1 - line[k, 2])))
    free = ~np.append(held, np.zeros(3 * J, bool))
    expected = np.zeros(n + 3 * J)
    expected[free] = np.linalg.lstsq(np.vstack(rows)[:, free], np.concatenate(right))[0]
    np.testing.assert_allclose(x, expected[:n], atol=1e-9)
    np.testing.assert_allclose(after, line + expected[n:].reshape(J, 3), atol=1e-9)


FLOOR = np.array(
    [[[x, -0.8], [x, 0.8]] for x in (1.2, 1.7, 2.3)] + [[[0.9, y], [3, y]] for y in (-0.5, 0.2)]
)


def seen_from(camera, mount, pose):
    ends = np.zeros((M, 2, 2))
    seen = reference.look(camera, mount, pose, FLOOR)
    ends[: len(seen)] = seen
    segments = Segments(jnp.asarray(ends), jnp.arange(M) < len(seen))
    return measure(CONFIG.sensor, camera, mount, segments, 8.0)


@pytest.mark.usefixtures("x64")
def test_an_estimate_that_is_off_comes_back_with_the_window(camera, mount):
    """Lines seen without noise, an odometer that reads three per cent too much."""
    model = MotionModel(distance_scale_sigma=0.05)
    window_config, map_config = FixedLagConfig(keyframes=5, lines=16), CONFIG.segment_map
    config = dataclasses.replace(CONFIG, motion=model, window=window_config)
    slam = SofSlam(config, camera, mount)
    bias = OdometerBias(jnp.zeros(4), jnp.diag(jnp.array([0.05, 0.05, 0.05, 0.005]) ** 2))
    go = jit_quickly(slide)
    nadir, drifted = mount.T_robot_nadir, None
    step = SE2(jnp.array([0.2, 0.0]), jnp.array(0.02))
    read = SE2(jnp.array([0.206, 0.0]), jnp.array(0.02))
    true = estimate = SE2.identity()
    for i in range(5):
        measurements = seen_from(camera, mount, (*np.asarray(true.xy), float(true.yaw)))
        if i == 0:
            m, window = (
                map_of(measurements, nadir),
                empty_window(window_config, map_config.capacity, measurements),
            )
        new = jnp.where(measurements.valid, jnp.arange(M), map_config.capacity)
        new = new if i == 0 else jnp.full(M, map_config.capacity)
        image = Image(
            estimate, jnp.zeros(2), bias, Mapped(measurements, new), read if i else true,
            jnp.zeros(3),
        )  # fmt: skip
        window, m, T = go(slam, window, m, image)
        drifted = estimate
        estimate = T @ estimate
        np.testing.assert_allclose(estimate.xy, true.xy, atol=1e-3)
        np.testing.assert_allclose(estimate.yaw, true.yaw, atol=1e-3)
        true, estimate = true @ step, estimate @ read
    assert np.hypot(*(drifted.xy - (true @ step.inverse()).xy)) > 5e-3
    assert int(window.count) == 5


def map_of(measurements, T_world_nadir):
    """Each segment of the first image begins a line, in the slot of its number."""
    m, n = empty_map(CONFIG.segment_map), int(measurements.valid.sum())
    line = jnp.stack([measurements.line.rho, measurements.line.theta, jnp.ones(M)], axis=1)[:n]
    ends = T_world_nadir.apply(measurements.endpoints_nadir[:n])
    put = lambda a, b: a.at[:n].set(b)
    return eqx.tree_at(
        lambda m: (m.segments_world.endpoints, m.segments_world.valid, m.line, m.covariance,
                   m.anchor.xy, m.updates),
        m,
        (put(m.segments_world.endpoints, ends), put(m.segments_world.valid, True),
         put(m.line, line), put(m.covariance, 1e-3 * jnp.eye(3)),
         put(m.anchor.xy, T_world_nadir.xy),
         put(m.updates, 9)),
    )  # fmt: skip


def test_a_drive_is_compiled_once_and_stays_near_the_truth():
    step = jit_quickly(eqx.debug.assert_max_traces(SofSlam.step.__wrapped__, max_traces=1))
    true, observations = drive()
    state, xy = start(OPEN), []
    for i in range(len(true)):
        one = jax.tree.map(lambda a, i=i: a[i], observations)
        state, info = step(SofSlam(OPEN, CAMERA, MOUNT), state, one)
        xy.append(info.T_world_robot.xy)
    assert int(state.window.count) > 8
    off = np.hypot(*(np.array(xy) - true[:, :2]).T)
    assert np.isfinite(off).all() and off.max() < 0.03

    # nothing seen: the window waits, and the particles go on by the odometer
    after, _ = step(
        SofSlam(OPEN, CAMERA, MOUNT), state, black(SE2(jnp.array([0.3, 0.0]), jnp.zeros(())))
    )
    assert int(after.window.count) == int(state.window.count)
    off = after.window.motion.xy - state.window.motion.xy
    np.testing.assert_allclose(off, [0.3, 0], atol=0.02)


def test_without_a_window_nothing_is_carried():
    assert start().window is None
