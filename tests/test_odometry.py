"""What is no motion is found in the odometry, taken out, and told as an unknown motion."""

import numpy as np
import pytest

from sofjax.io.contradictions import contradictions
from sofjax.io.odometry import (
    FASTER,
    MIN_SIGMA,
    Outage,
    Speeds,
    extended,
    mend,
    unknown_motion,
    usual_speeds,
)
from sofjax.io.trajectory import Trajectory

PERIOD, SPEED, TURN = 0.04, 0.6, 0.3
LINES = np.arange(2, 2000)


def driven(seconds=8.0, start=0.0):
    """Along an arc at a steady speed, row after row."""
    t = start + np.arange(0, seconds, PERIOD)
    yaw = TURN * (t - start)
    x, y = SPEED / TURN * np.sin(yaw), SPEED / TURN * (1 - np.cos(yaw))
    return Trajectory(t, np.stack([x, y], axis=1), yaw)


def steps(trajectory):
    """[n - 1, 3] in the frame of each row."""
    c, s = np.cos(trajectory.yaw[:-1]), np.sin(trajectory.yaw[:-1])
    dx, dy = np.diff(trajectory.xy, axis=0).T
    return np.stack([c * dx + s * dy, c * dy - s * dx, np.diff(trajectory.yaw)], axis=1)


def without(trajectory, rows):
    keep = np.ones(len(trajectory.stamps), bool)
    keep[rows] = False
    return Trajectory(trajectory.stamps[keep], trajectory.xy[keep], trajectory.yaw[keep]), keep


def mended(read, lines=LINES):
    return mend("odometry.txt", lines[: len(read.stamps)], read)


def test_a_clean_odometry_is_returned_as_it_is():
    read = driven()
    same, outages = mended(read)
    assert same is read and outages == []
    same, outages = mended(Trajectory(read.stamps[:2], read.xy[:2], read.yaw[:2]))
    assert len(same.stamps) == 2 and outages == []


@pytest.mark.parametrize("jump", [(1.5, 0, 0), (0.3, 0, 0), (0, -0.2, 0), (0, 0, 0.4)])
def test_a_jump_is_taken_out_and_the_path_goes_on_at_the_speed_around_it(jump):
    true = driven()
    c, s = np.cos(true.yaw[100]), np.sin(true.yaw[100])
    turned = np.array([[np.cos(jump[2]), -np.sin(jump[2])], [np.sin(jump[2]), np.cos(jump[2])]])
    at = true.xy[100]
    behind = (
        (true.xy[101:] - at) @ turned.T
        + at
        + [c * jump[0] - s * jump[1], s * jump[0] + c * jump[1]]
    )
    read = Trajectory(
        true.stamps,
        np.concatenate([true.xy[:101], behind]),
        np.append(true.yaw[:101], true.yaw[101:] + jump[2]),
    )
    found, (outage,) = mended(read)
    np.testing.assert_allclose(found.xy, true.xy, atol=1e-3)
    np.testing.assert_allclose(found.yaw, true.yaw, atol=1e-3)
    assert (outage.begin, outage.end) == (true.stamps[100], true.stamps[101])
    assert not outage.bridged and "line 103: a step of" in outage.sentence


def test_a_restart_at_the_origin_is_one_even_behind_a_hole():
    true = driven()
    again = driven(4.0)
    for hole in (1, 60):
        rows = 100 + hole
        read = Trajectory(
            true.stamps[: 100 + 100],
            np.concatenate([true.xy[:100], again.xy[:100]]),
            np.append(true.yaw[:100], again.yaw[:100]),
        )
        stamps = read.stamps.copy()
        stamps[100:] += PERIOD * (hole - 1)
        found, (outage,) = mended(Trajectory(stamps, read.xy, read.yaw))
        assert "restarts at the origin" in outage.sentence and not outage.bridged
        np.testing.assert_allclose(found.yaw[100], TURN * PERIOD * (rows - 1), atol=0.01)
        np.testing.assert_allclose(found.xy[100], driven(9.0).xy[rows - 1], atol=0.06)
        np.testing.assert_allclose(steps(found)[100:], steps(again)[:99], atol=1e-9)


def test_a_pose_that_stands_still_and_catches_up_is_bridged():
    true = driven()
    xy, yaw = true.xy.copy(), true.yaw.copy()
    xy[100:125], yaw[100:125] = xy[100], yaw[100]
    found, (outage,) = mended(Trajectory(true.stamps, xy, yaw))
    assert outage.bridged and "stands still" in outage.sentence and "line 127" in outage.sentence
    assert (outage.begin, outage.end) == (true.stamps[100], true.stamps[125])
    assert len(found.stamps) == len(true.stamps) - 24
    np.testing.assert_allclose(found.at(true.stamps).yaw, true.yaw, atol=1e-9)


def test_a_robot_that_stops_is_no_stall_and_one_that_starts_is_no_jump():
    true = driven(4.0)
    still = np.repeat(true.xy[-1:], 100, axis=0)
    behind = true.xy[1:] + true.xy[-1]
    xy = np.concatenate([true.xy, still, behind])
    yaw = np.concatenate([true.yaw, np.full(100, true.yaw[-1]), true.yaw[-1] + true.yaw[1:]])
    read = Trajectory(PERIOD * np.arange(len(xy)), xy, yaw)
    assert mended(read)[0] is read


def test_poses_held_between_slow_updates_are_interpolated_without_a_word():
    true = driven()
    held = np.arange(len(true.stamps)) // 5 * 5
    read = Trajectory(true.stamps, true.xy[held], true.yaw[held])
    found, outages = mended(read)
    assert outages == [] and len(found.stamps) <= len(true.stamps) // 5 + 10


def test_a_hole_is_bridged_and_told_with_its_times():
    true = driven()
    read, keep = without(true, slice(60, 160))
    found, (outage,) = mended(read, LINES[: len(keep)][keep])
    assert found is read and outage.bridged
    assert outage.end - outage.begin == pytest.approx(101 * PERIOD)
    assert outage.sentence == "odometry.txt, line 162: no row for 4.04 s from 2.36 s on"


def test_a_few_readings_dropped_are_no_hole():
    assert mended(without(driven(), slice(60, 70))[0])[1] == []
    slow = driven(40.0)
    slow = Trajectory(slow.stamps[::20], slow.xy[::20], slow.yaw[::20])  # at 1.25 Hz
    assert mended(slow)[0] is slow


@pytest.mark.parametrize("seed", range(8))
def test_no_ordinary_drive_has_an_outage(seed):
    """Speeds that vary, stops, turns on the spot, jitter of stamps and of poses, at many rates."""
    rng = np.random.default_rng(seed)
    period = rng.choice([0.005, 0.02, 0.04, 0.1, 0.2])
    n = int(60 / period)
    knots = np.linspace(0, 60, 25)
    t = np.cumsum(period * rng.uniform(0.3, 1.7, n))
    fast = rng.choice([0.2, 0.7, 1.5, 15.0])
    v = np.interp(t, knots, np.maximum(0, rng.uniform(-0.3, fast, 25)))
    w = np.interp(t, knots, rng.normal(0, 0.8, 25))
    yaw = np.cumsum(w * period)
    xy = np.cumsum(v[:, None] * period * np.stack([np.cos(yaw), np.sin(yaw)], axis=1), axis=0)
    xy += rng.normal(0, 2e-4, xy.shape)
    assert mended(Trajectory(t, xy, yaw), np.arange(n))[1] == []


def test_a_long_step_is_judged_by_the_usual_speed():
    read = driven()
    usual = usual_speeds(read)
    np.testing.assert_allclose([usual.forward, usual.turn], [SPEED, TURN], rtol=0.01)
    fast = read.xy.copy()
    fast[100:] += 0.5 * FASTER * SPEED * PERIOD * np.array([1, 0])
    assert mended(Trajectory(read.stamps, fast, read.yaw))[0].xy is fast


def test_what_is_not_known_of_a_motion_is_half_the_usual_speed():
    stamps, speeds = 0.1 * np.arange(50), Speeds(0.8, 1.0)
    assert unknown_motion([], speeds, stamps) is None
    hole = unknown_motion([Outage(1.0, 3.0, True, "")], speeds, stamps)
    assert not hole[:11].any() and not hole[31:].any()
    left = np.sqrt(1 - 0.1 / 2.0)  # of a bridge that is known as a whole
    np.testing.assert_allclose(hole[15], left * 0.1 * np.array([0.4, 0.4, 0.5]), rtol=1e-6)
    over = unknown_motion([Outage(1.0, 3.0, True, "")], speeds, np.array([0.0, 0.9, 3.1]))
    assert over is None  # from before the hole to behind it the poses tell all
    jump = unknown_motion([Outage(1.02, 1.06, False, "")], speeds, stamps)
    assert np.flatnonzero(jump.any(axis=1)).tolist() == [11]
    np.testing.assert_allclose(jump[11, 0], np.hypot(0.4 * 0.04, MIN_SIGMA), rtol=1e-6)
    assert unknown_motion([Outage(9.0, 9.5, False, "")], speeds, stamps) is None


def test_images_beyond_the_odometry_have_half_the_speed_of_its_end():
    read = driven()
    same, outages = extended("odometry.txt", read, np.array([-0.1, 4.0, 8.1]))
    assert same is read and outages == []
    found, (before, behind) = extended("odometry.txt", read, np.array([-1.0, 4.0, 9.96]))
    np.testing.assert_allclose(found.stamps[[0, -1]], [-1.0, 9.96])
    np.testing.assert_array_equal(found.xy[1:-1], read.xy)
    first, last = steps(found)[[0, -1]]
    np.testing.assert_allclose(np.hypot(*last[:2]), 0.5 * SPEED * 2.0, rtol=0.02)
    np.testing.assert_allclose(last[2], 0.5 * TURN * 2.0, rtol=1e-6)
    np.testing.assert_allclose(np.hypot(*first[:2]), 0.5 * SPEED * 1.0, rtol=0.02)
    np.testing.assert_allclose(first[2], 0.5 * TURN * 1.0, rtol=1e-6)
    assert (before.begin, before.end) == (-1.0, 0.0) and "no row before 0.00 s" in before.sentence
    assert behind.end == 9.96 and not (before.bridged or behind.bridged)
    stood = Trajectory(read.stamps, 0 * read.xy, 0 * read.yaw)
    assert not extended("odometry.txt", stood, np.array([0.0, 20.0]))[0].xy.any()


CONTRARY = {
    "as it is": (lambda xy, yaw: (xy, yaw), None),
    "swapped": (lambda xy, yaw: (xy[:, ::-1], yaw), "heading does not follow"),
    "reversed": (lambda xy, yaw: (-xy, yaw), "backwards by its heading"),
    "heading of the y axis": (lambda xy, yaw: (xy, yaw + np.pi / 2), "-90° to the side"),
    "wrong sign": (lambda xy, yaw: (xy, -yaw), "heading does not follow"),
    "degrees": (lambda xy, yaw: (xy, np.degrees(yaw)), "heading does not follow"),
    "millimetres": (lambda xy, yaw: (1000 * xy, yaw), "line 3: 24 m in 0.040 s are 600 m/s"),
}


@pytest.mark.parametrize("fault", CONTRARY)
def test_an_odometry_that_contradicts_itself_is_told(fault):
    change, sentence = CONTRARY[fault]
    true = driven()
    read = Trajectory(true.stamps, *change(true.xy, true.yaw))
    found = contradictions("odometry.txt", LINES, read, read)
    assert len(found) == (sentence is not None)
    assert sentence is None or sentence in found[0]


def test_a_robot_that_drives_back_where_it_came_from_contradicts_nothing():
    read = driven()
    xy = np.concatenate([read.xy, read.xy[::-1]])
    both = Trajectory(PERIOD * np.arange(400), xy, np.append(read.yaw, read.yaw[::-1]))
    assert contradictions("odometry.txt", LINES, both, both) == []


def test_a_robot_that_stands_and_trembles_contradicts_nothing():
    rng = np.random.default_rng(0)
    read = Trajectory(PERIOD * np.arange(2000), rng.normal(0, 0.002, (2000, 2)), np.zeros(2000))
    assert contradictions("odometry.txt", LINES, read, read) == []
