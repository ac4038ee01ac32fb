"""One sensor model, two evaluations: the filter's and the batch's say the same."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import jit_quickly, make_camera
from test_slam import CAMERA, CONFIG, MOUNT, default_run, frame

from sofjax import LineNoise, SofSlam, log_likelihood, pose_log_likelihood
from sofjax.geometry import SE2, Mount, Segments
from sofjax.geometry.lines import polar_through
from sofjax.likelihood.measurements import Measurements
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.segment_map import MapConfig, empty_map
from sofjax.slam.reweight import hard_log_likelihood, local_map

K, M, N = 6, 5, 40
NOISE = LineNoise(0.05, 0.03, 9.0)


def long_lines(rng):
    """K lines about the origin, long enough to overlap with whatever is seen of them."""
    angle = np.pi * (np.arange(K) + rng.uniform(-0.2, 0.2, K)) / K
    middle = rng.uniform(1.0, 3.0, (K, 1)) * np.stack([-np.sin(angle), np.cos(angle)], 1)
    along = 30 * np.stack([np.cos(angle), np.sin(angle)], 1)
    return np.stack([middle - along, middle + along], axis=1)


def as_map(config, ends):
    """The map of a filter that is certain of these lines."""
    lines = Segments.of(ends)
    polar = jax.vmap(polar_through)(lines.endpoints)
    m = empty_map(config)
    return dataclasses.replace(
        m, segments_world=lines, line=jnp.stack([polar.rho, polar.theta, jnp.ones(K)], axis=1)
    )


@pytest.mark.usefixtures("x64")
def test_with_constant_sigmas_and_no_jitter_both_evaluations_are_equal(rng):
    """All lines are candidates of every segment, and all overlap."""
    sensor = SensorModel(propagate=False, rho_sigma=0.05, theta_sigma=0.03, tilt_sigma=0.0)
    map_config = MapConfig(
        capacity=K, nearby=K, candidates=K, rho_drift=0.0, theta_drift=0.0, directed=False
    )
    config = dataclasses.replace(CONFIG, sensor=sensor, segment_map=map_config)
    slam = SofSlam(config, make_camera(), Mount.create(height=0.6, pitch=0.26))
    ends = long_lines(rng)
    turned = ends[:M].mean(axis=1, keepdims=True) + 0.03 * (ends[:M] - ends[:M].mean(1)[:, None])
    observed = Segments.of(turned + rng.normal(0, 0.02, (M, 2, 2)))
    polar = jax.vmap(polar_through)(observed.endpoints)
    constant = jnp.diag(jnp.array([0.05, 0.03]) ** 2)
    measurements = Measurements(
        observed.endpoints, observed.valid, polar,
        jnp.broadcast_to(constant, (M, 2, 2)), jnp.zeros((M, 2, 2)),
    )  # fmt: skip
    poses = rng.normal(0, [0.05, 0.05, 0.03], (N, 3))
    T = SE2(jnp.asarray(poses[:, :2]), jnp.asarray(poses[:, 2]))
    local = local_map(slam, as_map(map_config, ends), measurements, SE2.identity())
    used = jnp.ones((M, N), bool)
    tracked = hard_log_likelihood(slam, measurements, local, T, used)
    batch = log_likelihood(T, observed, Segments.of(ends), NOISE)
    assert np.ptp(np.asarray(batch)) > 1
    np.testing.assert_allclose(tracked, batch, rtol=1e-4)


def test_a_pose_is_scored_as_a_step_weights_its_particles():
    """Poses about the estimate; one call for one of them and for many."""
    state, info = default_run()
    slam = SofSlam(CONFIG, CAMERA, MOUNT)
    segments = frame(-1).segments_image
    estimate = jax.tree.map(lambda a: a[-1], info.T_world_robot)
    off = jnp.array([[0, 0, 0], [0, 0.05, 0], [0, 0, 0.03], [0.2, 0, 0], [0, 0, -0.03]], "float32")
    poses = SE2(estimate.xy + off[:, :2], estimate.yaw + off[:, 2])
    many = pose_log_likelihood(slam, state, segments, poses)
    assert many.shape == (5,) and int(many.argmax()) == 0
    one = pose_log_likelihood(slam, state, segments, estimate)
    assert one.shape == () and one == pytest.approx(float(many[0]), abs=0.5)

    turned = pose_log_likelihood(
        slam, state, segments, SE2(poses.xy, poses.yaw.at[1].add(2 * np.pi))
    )
    np.testing.assert_allclose(turned, many, rtol=1e-3, atol=0.05)

    def of_height(height):
        at = dataclasses.replace(slam, mount=dataclasses.replace(MOUNT, height=height))
        return pose_log_likelihood(at, state, segments, estimate)

    gradient = jit_quickly(jax.grad(of_height))(MOUNT.height)
    assert np.isfinite(gradient) and gradient != 0


def test_without_segments_every_pose_is_alike():
    state, _ = default_run()
    nothing = Segments(jnp.zeros((32, 2, 2)), jnp.zeros(32, bool))
    poses = SE2(jnp.zeros((3, 2)), jnp.zeros(3))
    found = pose_log_likelihood(SofSlam(CONFIG, CAMERA, MOUNT), state, nothing, poses)
    np.testing.assert_array_equal(found, 0)
