"""The measures by worked examples, and against plain loops."""

import numpy as np
import pytest

from sofjax.cli.summaries import errors_table
from sofjax.evaluation import (
    MapErrors,
    RigidMotion,
    align,
    distance_to_segments,
    evaluate_map,
    evaluate_trajectory,
    sample,
)
from sofjax.io.errors import InputError
from sofjax.io.trajectory import Trajectory

STILL = RigidMotion(np.eye(2), np.zeros(2))


def turned(angle, shift):
    c, s = np.cos(angle), np.sin(angle)
    return RigidMotion(np.array([[c, -s], [s, c]]), np.array(shift, float))


def straight(length=8.0, n=401):
    x = np.linspace(0, length, n)
    return Trajectory(np.linspace(0, 40, n), np.stack([x, 0 * x], 1), 0 * x)


def curved(seed=0, n=300):
    rng = np.random.default_rng(seed)
    yaw = np.cumsum(rng.normal(0, 0.05, n))
    xy = np.cumsum(0.05 * np.stack([np.cos(yaw), np.sin(yaw)], 1), axis=0)
    return Trajectory(0.1 * np.arange(n), xy, yaw)


def test_true_poses_in_a_gap_of_the_estimate_are_left_out():
    """What is interpolated over a gap is nobody's estimate, and no error of it."""
    truth = curved()
    keep = (truth.stamps < 10) | (truth.stamps > 14)
    estimate = Trajectory(truth.stamps[keep], truth.xy[keep], truth.yaw[keep])
    errors, _ = evaluate_trajectory(truth, estimate)
    assert errors.max_m == pytest.approx(0, abs=1e-9)
    assert errors.yaw_deg == pytest.approx(0, abs=1e-6)
    assert errors.coverage == pytest.approx(keep.mean(), abs=0.01)
    keep = np.arange(300) % 10 != 5  # an estimate missed now and then is interpolated
    estimate = Trajectory(truth.stamps[keep], truth.xy[keep], truth.yaw[keep])
    assert evaluate_trajectory(truth, estimate)[0].coverage == 1


def test_the_table_of_errors_stays_a_table():
    truth = straight()
    far = Trajectory(truth.stamps, truth.xy * 1e6, truth.yaw)
    still = Trajectory(truth.stamps, 0 * truth.xy, truth.yaw)
    few, _ = evaluate_trajectory(still, still)
    large, _ = evaluate_trajectory(truth, far)
    nothing = MapErrors(0, 0.0, 0.0, 0.0, float("nan"))
    lines = errors_table(large, few, large, nothing)
    assert "nan" not in "".join(lines) and len({len(line) for line in lines[:-3]}) == 1
    assert all(len(line.split("  ")[-1].split()) <= 2 for line in lines)
    assert lines[-1].endswith(" -")


def test_alignment_finds_a_rigid_motion_and_no_scale():
    points = np.random.default_rng(0).normal(size=(50, 2))
    motion = turned(2.5, [3, -1])
    found = align(points, motion.apply(points))
    np.testing.assert_allclose(found.R, motion.R)
    np.testing.assert_allclose(found.t, motion.t)
    assert found.yaw == pytest.approx(2.5)
    np.testing.assert_allclose(np.linalg.det(align(points, 3 * motion.apply(points)).R), 1)
    mirrored = points * [1, -1]
    np.testing.assert_allclose(np.linalg.det(align(points, mirrored).R), 1)


def test_a_moved_copy_of_the_truth_has_no_error():
    truth = curved()
    motion = turned(-2.0, [5, 5])
    errors, back = evaluate_trajectory(
        truth, Trajectory(truth.stamps, motion.apply(truth.xy), truth.yaw - 2.0 + 2 * np.pi)
    )
    assert errors.coverage == 1
    for name in ("ate_m", "max_m", "yaw_deg", "drift_percent", "end_gap_m"):
        assert getattr(errors, name) == pytest.approx(0, abs=1e-9)
    assert back.yaw == pytest.approx(2.0)


def test_errors_of_a_path_that_is_a_tenth_too_long():
    """Positions x become 1.1 x; aligned at the middle they are off by 0.1 |x - 4|."""
    truth = straight()
    errors, _ = evaluate_trajectory(truth, Trajectory(truth.stamps, 1.1 * truth.xy, truth.yaw))
    assert errors.path_m == pytest.approx(8)
    assert errors.ate_m == pytest.approx(0.1 * 8 / np.sqrt(12), rel=0.01)
    assert errors.ate_percent == pytest.approx(100 * errors.ate_m / 8)
    assert errors.max_m == pytest.approx(0.4)
    assert errors.yaw_deg == pytest.approx(0)
    assert errors.drift_percent == pytest.approx(10, rel=1e-3)
    assert errors.end_gap_m == pytest.approx(0.1 * 8, abs=0.06)  # the first metre's own 5 cm


def test_heading_errors_are_those_left_after_alignment():
    truth = straight()
    turn = np.deg2rad(np.where(np.arange(401) % 2, 2.0, -2.0))
    errors, _ = evaluate_trajectory(truth, Trajectory(truth.stamps, truth.xy, turn))
    assert errors.ate_m == pytest.approx(0, abs=1e-9)
    assert errors.yaw_deg == pytest.approx(2.0)


def test_drift_against_a_plain_loop():
    truth, estimate = curved(0), curved(0)
    rng = np.random.default_rng(1)
    estimate = Trajectory(
        truth.stamps,
        truth.xy + np.cumsum(rng.normal(0, 0.003, (300, 2)), axis=0),
        truth.yaw + np.cumsum(rng.normal(0, 0.003, 300)),
    )
    errors, _ = evaluate_trajectory(truth, estimate)
    travelled = np.append(0, np.cumsum(np.hypot(*np.diff(truth.xy, axis=0).T)))
    stretch = travelled[-1] / 4
    found = []
    for i in range(300):
        ends = [j for j in range(300) if travelled[j] >= travelled[i] + stretch]
        if ends:
            at_start = turned(truth.yaw[i] - estimate.yaw[i], [0, 0])
            moved = at_start.apply(estimate.xy[ends[0]] - estimate.xy[i])
            found.append(np.linalg.norm(moved - (truth.xy[ends[0]] - truth.xy[i])) / stretch)
    assert errors.drift_percent == pytest.approx(100 * np.mean(found))


def test_half_a_trajectory_is_compared_with_its_half_of_the_truth():
    truth = straight()
    half = Trajectory(truth.stamps[:201], truth.xy[:201], truth.yaw[:201])
    errors, _ = evaluate_trajectory(truth, half)
    assert errors.coverage == pytest.approx(0.5, abs=0.01)
    assert errors.path_m == pytest.approx(4)
    assert errors.ate_m == pytest.approx(0, abs=1e-9)


def test_a_robot_that_stands_still_has_no_percentages():
    truth = Trajectory(np.arange(5.0), np.zeros((5, 2)), np.zeros(5))
    errors, _ = evaluate_trajectory(truth, truth)
    assert errors.ate_m == 0
    assert np.isnan(errors.ate_percent) and np.isnan(errors.drift_percent)


def test_times_that_do_not_meet_are_refused():
    truth = straight()
    with pytest.raises(InputError, match="share"):
        evaluate_trajectory(truth, Trajectory(truth.stamps + 100, truth.xy, truth.yaw))


PATH = np.stack([np.linspace(0, 4, 50), np.zeros(50)], 1)
TRUTH = np.array([[[0, 1], [4, 1]], [[0, -1], [4, -1]], [[0, 10], [4, 10]]], float)


def test_a_map_with_one_right_line_one_false_and_one_missing():
    """3 m right to 2 cm, 1 m false; 3 m are found of the 8 m in view, which 10 m away is not."""
    found = np.array([[[0, 1.02], [3, 1.02]], [[1, 0], [2, 0]]], float)
    errors = evaluate_map(TRUTH, found, STILL, PATH)
    assert errors.segments == 2
    assert errors.length_m == pytest.approx(4)
    assert errors.precision == pytest.approx(3 / 4)
    assert errors.recall == pytest.approx(3 / 8, abs=0.02)
    assert errors.error_m == pytest.approx(0.02)


def test_a_line_at_an_angle_is_not_the_true_one():
    across = np.array([[[2, 0.96], [2.04, 1.04]]], float)
    assert evaluate_map(TRUTH, across, STILL, PATH).precision == 0
    tilted = np.array([[[1.9, 0.995], [2.1, 1.005]]], float)  # 2.9 degrees
    assert evaluate_map(TRUTH, tilted, STILL, PATH).precision == 1


def test_the_map_is_moved_as_the_trajectory_was():
    motion = turned(1.0, [2, 3])
    away = RigidMotion(motion.R.T, -motion.R.T @ motion.t).apply(TRUTH)
    errors = evaluate_map(TRUTH, away, motion, PATH)
    assert errors.precision == 1 and errors.recall == 1
    assert errors.error_m == pytest.approx(0, abs=1e-9)


def test_an_empty_map_finds_nothing():
    errors = evaluate_map(TRUTH, np.zeros((0, 2, 2)), STILL, PATH)
    assert (errors.segments, errors.length_m, errors.precision, errors.recall) == (0, 0, 0, 0)
    assert np.isnan(errors.error_m)


def test_samples_are_even_and_two_at_least():
    points, angles = sample(np.array([[[0, 0], [0.1, 0]], [[1, 1], [1, 1.001]]]))
    np.testing.assert_allclose(points[:5, 0], [0.01, 0.03, 0.05, 0.07, 0.09])
    assert len(points) == 7
    np.testing.assert_allclose(angles, [0] * 5 + [np.pi / 2] * 2)


def test_distances_against_a_plain_loop():
    rng = np.random.default_rng(0)
    points, angles = rng.uniform(-3, 3, (200, 2)), rng.uniform(-np.pi, np.pi, 200)
    segments = rng.uniform(-3, 3, (30, 2, 2))
    segments[3, 1] = segments[3, 0]  # of no length
    expected = []
    for point, angle in zip(points, angles, strict=True):
        best = np.inf
        for a, b in segments:
            d = b - a
            if np.linalg.norm(d) < 1e-6:
                continue
            turn = abs((angle - np.arctan2(d[1], d[0])) % np.pi)
            if min(turn, np.pi - turn) < np.deg2rad(5):
                share = np.clip((point - a) @ d / (d @ d), 0, 1)
                best = min(best, np.linalg.norm(point - a - share * d))
        expected.append(best)
    np.testing.assert_allclose(distance_to_segments(points, angles, segments), expected)
