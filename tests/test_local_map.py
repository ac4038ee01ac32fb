"""The part of the map that an image may show, and the candidates of its segments."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from conftest import jit_quickly
from test_segment_map import (
    GAMMA,
    KALMAN,
    STIFF,
    K,
    M,
    across,
    assert_bitwise_equal,
    ends_of,
    everything,
    measurements_of,
    offset,
    pose,
    proposals,
    seen,
)

from sofjax.geometry import SE2, Mount, PolarLine, Segments
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.segment_map import (
    Observed,
    SegmentMap,
    empty_map,
    in_view,
    integrate,
    nearby,
    posterior_given_class,
    predict_measurement,
)

pytestmark = pytest.mark.usefixtures("x64")


def random_map(rng):
    roots = rng.normal(size=(K, 3, 3)) * [[0.02], [0.02], [0.05]]
    line = np.column_stack(
        [rng.normal(size=K), rng.uniform(-3, 3, K), rng.choice([1.0, 1.02, 1.4], K)]
    )
    anchors = rng.normal(size=(K, 3)) * [0.5, 0.5, 1]
    ends = rng.normal(size=(K, 2, 2)) * 2
    m = SegmentMap(
        Segments(jnp.asarray(ends), jnp.asarray(rng.random(K) < 0.8)),
        SE2(jnp.asarray(anchors[:, :2]), jnp.asarray(anchors[:, 2])),
        jnp.asarray(line),
        jnp.asarray(np.einsum("kij,klj->kil", roots, roots) + 1e-6 * np.eye(3)),
        *(jnp.ones(K, int) for _ in range(4)),
    )
    return m


@pytest.mark.parametrize("propagate", [True, False])
def test_the_candidates_are_the_nearest_lines_of_a_loop_over_all_pairs(propagate, rng):
    rules = dataclasses.replace(KALMAN, rho_drift=0.01, theta_drift=0.02, candidates=3)
    sensor = SensorModel(propagate=propagate, tilt_sigma=0.05)
    for _ in range(3):
        m = random_map(rng)
        measurements = dataclasses.replace(
            measurements_of(*(rng.normal(size=(M, 2, 2)))),
            by_jitter=jnp.asarray(rng.normal(size=(M, 2, 2))),
        )
        at = pose(*rng.normal(size=3) * 0.3)
        candidates, slot, nearest = proposals(rules, sensor, m, measurements, at)
        for i in range(M):
            errors, kept = np.full(K, np.inf), {}
            for k in range(K):
                anchor = SE2(m.anchor.xy[k], m.anchor.yaw[k])
                line, P = posterior_given_class(rules, m.line[k], m.covariance[k])
                seen_line, H = predict_measurement(line, anchor, at)
                S = np.asarray(measurements.covariance[i]) + np.diag([0.01**2, 0.02**2])
                opposite = np.cos(measurements.line.theta[i] - seen_line[1]) < 0
                by_its_name = np.diag([-1, 1]) if opposite else np.eye(2)
                S = S + (by_its_name @ np.asarray(H @ P @ H.T) @ by_its_name if propagate else 0)
                J = np.asarray(measurements.by_jitter[i])
                S_tilt = S + 0.05**2 * J @ J.T
                extent = float(seen_line[2]) * at.inverse().apply(m.segments_world.endpoints[k])
                if m.valid[k] and reference.overlap(extent, measurements.endpoints_nadir[i]) > -0.3:
                    line_i = (measurements.line.rho[i], measurements.line.theta[i])
                    d = np.array(reference.polar_difference(line_i, seen_line[:2]))
                    errors[k] = d @ np.linalg.inv(S_tilt) @ d
                    kept[k] = (S, S_tilt, seen_line)
            order = [k for k in np.argsort(errors)[:3] if np.isfinite(errors[k])]
            assert nearest[i] == pytest.approx(errors.min(), rel=1e-6)
            assert candidates.valid[i].sum() == len(order)
            np.testing.assert_array_equal(slot[i, : len(order)], order)
            for j, k in enumerate(order):
                S, S_tilt, seen_line = kept[k]
                np.testing.assert_allclose(candidates.precision[i, j], np.linalg.inv(S), rtol=1e-6)
                np.testing.assert_allclose(
                    candidates.precision_with_jitter[i, j], np.linalg.inv(S_tilt), rtol=1e-6
                )
                found = (
                    candidates.line.rho[i, j],
                    candidates.line.theta[i, j],
                    candidates.apparent_scale[i, j],
                )
                np.testing.assert_allclose(found, seen_line, atol=1e-9)


def test_an_empty_map_proposes_nothing():
    candidates, _, nearest = proposals(
        KALMAN, STIFF, empty_map(KALMAN), measurements_of(across(1.0)), pose()
    )
    assert not candidates.valid.any()
    np.testing.assert_array_equal(nearest, jnp.inf)
    for leaf in jax.tree.leaves(candidates):
        assert np.isfinite(leaf).all()


def test_a_piece_beyond_the_end_of_its_line_is_proposed_up_to_the_gap():
    m = seen(empty_map(KALMAN), across(1.0, 0, 2), rules=KALMAN)
    for x0, expected in ((2.2, True), (2.4, False)):
        candidates, _, nearest = proposals(
            KALMAN, STIFF, m, measurements_of(across(1.0, x0, 3)), pose()
        )
        assert bool(candidates.valid[0, 0]) == expected
        assert bool(np.isfinite(nearest[0])) == expected


def test_the_lines_nearby_are_all_that_a_loop_finds_within_reach(rng):
    """If they are no more than L; else the nearest, and what is left out within reach is told."""
    m, at = random_map(rng), pose(0.4, -0.3, 1.0)
    distance = []
    for ends, apparent_scale in zip(m.segments_world.endpoints, m.line[:, 2], strict=True):
        a, b = np.asarray(ends) - np.asarray(at.xy)
        points = a + np.linspace(0, 1, 100_001)[:, None] * (b - a)
        distance.append(float(apparent_scale) * np.linalg.norm(points, axis=1).min())
    order = [k for k in np.argsort(distance) if m.valid[k]]
    assert 4 < len(order) < K
    for L in (1, 3, len(order), K):
        reach = 0.5 * (distance[order[3]] + distance[order[4]])  # four of them lie within it
        slots, truncated = nearby(dataclasses.replace(KALMAN, nearby=L), m, at, jnp.array(reach))
        found = [int(k) for k in slots if k < K]
        assert found == sorted(order[: len(found)]) and len(found) <= L
        assert truncated == max(0, 4 - len(found))
        assert len(found) == len(order) or L < len(order)
        taken = m.take(slots)
        np.testing.assert_array_equal(taken.valid, np.asarray(slots) < K)
        assert_bitwise_equal(m.put(slots, taken), m)


def test_lines_beyond_those_nearby_only_age():
    rules = dataclasses.replace(GAMMA, nearby=2)
    m = seen(empty_map(rules), across(1.0), across(2.0), rules=rules)
    m = seen(m, across(1.0), at=pose(0, 29), rules=rules)
    before = m.unseen[:3]
    near, _ = nearby(rules, m, pose(), jnp.array(6.0))
    np.testing.assert_array_equal(near, [0, 1])
    known = jnp.arange(M) < 1
    after, *_ = jit_quickly(integrate)(
        rules, STIFF, m,
        Observed(
            measurements_of(across(2.2)), jnp.zeros(2), pose(), near, jnp.zeros(2, bool),
            jnp.ones(M, int), known, everything(len(near)), ~known & known,
        ),
    )  # fmt: skip
    np.testing.assert_array_equal(after.updates[:3], [1, 2, 1])
    np.testing.assert_array_equal(
        after.unseen[:3], before * jnp.array([1, 0, 1]) + jnp.array([1, 0, 1])
    )
    np.testing.assert_array_equal(ends_of(after, 2), ends_of(m, 2))
    assert offset(after, 1) == pytest.approx(2.1)


def test_what_was_seen_too_long_ago_is_not_looked_for():
    m = seen(empty_map(GAMMA), across(1.0), across(2.0))
    m = seen(m, across(1.0), slots=[0])
    for recall, slots in ((0, [0]), (1, [0, 1])):
        rules = dataclasses.replace(GAMMA, recall=recall)
        near, truncated = nearby(rules, m, pose(), jnp.array(6.0))
        assert [int(k) for k in near if k < m.updates.shape[0]] == slots and truncated == 0


def test_what_is_in_view_worked_by_hand(camera):
    level = Mount.create(height=1.0)  # the image ends 270 / 120 m ahead
    middles = [(3, 0), (2.0, 0), (4, 1.5), (4, 3.0), (-3, 0), (5.5, 0)]
    expected = [True, False, True, False, False, False]
    ends = np.zeros((K, 2, 2))
    for k, middle in enumerate(middles):
        ends[k] = np.add(middle, [[-0.2, -0.1], [0.2, 0.1]])
    m = dataclasses.replace(
        empty_map(KALMAN), segments_world=Segments(jnp.asarray(ends), jnp.arange(K) < len(middles))
    )
    shown = functools.partial(in_view, KALMAN, camera, level)
    np.testing.assert_array_equal(shown(m, pose())[: len(middles)], expected)
    # a line over the floor appears farther away
    high = dataclasses.replace(m, line=m.line.at[1, 2].set(1.5))
    assert shown(high, pose())[1]
    # the same from elsewhere, turned
    T = pose(2, -1, 2.0)
    there = Segments(T.apply(m.segments_world.endpoints), m.valid)
    moved = dataclasses.replace(m, segments_world=there)
    np.testing.assert_array_equal(shown(moved, T)[: len(middles)], expected)


def test_a_line_and_its_polar_form_agree_about_the_anchor():
    m = seen(empty_map(KALMAN), across(1.0), at=pose(50, 20, 1.0), rules=KALMAN)
    line = PolarLine(m.line[0, 0], m.line[0, 1])
    np.testing.assert_allclose([line.rho, line.theta], [1, 0], atol=1e-9)
    np.testing.assert_allclose([*m.anchor.xy[0], m.anchor.yaw[0]], [50, 20, 1])
