"""Jumps, restarts, stalls and holes in the rows of an odometer, found and removed.

A wheel odometer is trusted from row to row, so one wrong row moves the whole path behind it. Here
such rows are found by the odometer's own usual speed and the path is mended. The times over which
the motion is not known are returned beside it.
"""

from dataclasses import dataclass

import numpy as np

from sofjax.io.trajectory import Trajectory

CLOSE = 0.2  # seconds that it may begin late or end early without a warning
NEAR = 3  # steps on either side from which a speed is taken
MIN_ROWS = 8  # below which there is no usual speed
USUAL = 0.8  # quantile of the speeds of a robot that moves
MOVING = 0.02  # metres and radians a second, above which it does
FASTER = 5.0  # times its usual speed, beyond which a step is no motion ...
SPEED, TURN_RATE = 1.0, 3.0  # ... nor where it is below this: metres, radians a second
SLACK_XY, SLACK_YAW = 0.05, np.deg2rad(5)  # of a step, metres and radians
HOLE_PERIODS, HOLE_SECONDS = 5.0, 0.5  # without a row, beyond which what lies between is not known
STALE_PERIODS = 2.5  # of one and the same pose ...
CAUGHT_UP = 0.6  # ... if the next step is this share of what was to be driven in that time
ZERO = 0.02  # metres and radians about the origin: where an odometer restarts ...
FROM = 0.3  # ... if it comes from so far away in one step
SHARE = 0.5  # of the usual speed: standard deviation of the speed that is not known
MIN_TURN_RATE = 0.3  # radians a second, standard deviation of a turn rate that is not known
MIN_SIGMA = 0.02  # metres and radians, standard deviation of a motion that nobody read


@dataclass(frozen=True)
class Outage:
    """A time over which the odometry does not give the robot's motion."""

    begin: float  # seconds
    end: float
    bridged: bool  # whether the poses at its two ends are still of one path
    sentence: str  # what was found, with its line


@dataclass(frozen=True)
class Speeds:
    """How fast a robot usually moves; zero where it does not."""

    forward: float  # metres a second
    turn: float  # radians a second


def mend(where: str, lines: np.ndarray, read: Trajectory) -> tuple[Trajectory, list[Outage]]:
    """The odometry without impossible rows, and the times over which the motion is not known.

    - A pose that stands still and then catches up (a driver that stalls): its stale rows go.
    - A hole in the rows, and what a stall leaves: the straight line between its ends stays.
    - A jump, or a restart at the origin: the path goes on behind it at the speed around it.

    Where nothing of this is found the trajectory is returned as it is.

    **Arguments:**
    - `where`: the file, for the sentences.
    - `lines`: [n], the line of each row.
    """
    if len(read.stamps) < MIN_ROWS:
        return read, []
    fresh = ~_stale(read)
    lines, mended = lines[fresh], read
    if not fresh.all():
        mended = Trajectory(read.stamps[fresh], read.xy[fresh], np.unwrap(read.yaw[fresh]))
    dt, distance, turn = between_rows(mended)
    speeds = usual_speeds(mended)
    period = float(np.median(np.diff(read.stamps)))
    hole = dt > max(HOLE_PERIODS * period, HOLE_SECONDS)
    restart = _restarts(mended)
    jump = restart | _too_far(dt, distance, turn, speeds, period)

    outages = []
    for i in np.flatnonzero(hole | jump):
        begin, end = float(mended.stamps[i]), float(mended.stamps[i + 1])
        at = f"{where}, line {lines[i + 1]}"
        if restart[i]:
            what = f"the odometry restarts at the origin, {distance[i]:.2f} m from the row before"
        elif jump[i]:
            usual = f"usually {speeds.forward:.2f} m and {np.degrees(speeds.turn):.0f}° a second"
            what = (
                f"a step of {distance[i]:.2f} m and {np.degrees(turn[i]):.0f}° in {dt[i]:.3f} s "
                f"({usual})"
            )
        elif not fresh[np.searchsorted(read.stamps, begin) + 1]:
            what = f"the pose stands still for {dt[i]:.2f} s from {begin:.2f} s on, then catches up"
        else:
            what = f"no row for {dt[i]:.2f} s from {begin:.2f} s on"
        outages.append(Outage(begin, end, not jump[i], f"{at}: {what}"))
    return (_without(mended, jump) if jump.any() else mended), outages


def extended(
    where: str, odometry: Trajectory, stamps: np.ndarray
) -> tuple[Trajectory, list[Outage]]:
    """The odometry with poses for the images that lie beyond its ends, and the time without it.

    There the robot may have driven on or stood: half of its speed at the end lies between.

    **Arguments:**
    - `where`: the file, for the sentences.
    - `stamps`: [T] of the images, seconds.
    """
    begin, end = float(odometry.stamps[0]), float(odometry.stamps[-1])
    twist = _steps_robot(odometry) / np.diff(odometry.stamps)[:, None]
    outages = []
    if stamps[0] < begin - CLOSE:
        outages.append(
            Outage(float(stamps[0]), begin, False, f"{where}: no row before {begin:.2f} s")
        )
        at = (stamps[0] - begin) * np.median(twist[:NEAR], axis=0) / 2
        odometry = _with_pose(odometry, 0, stamps[0], at)
    if stamps[-1] > end + CLOSE:
        outages.append(Outage(end, float(stamps[-1]), False, f"{where}: no row after {end:.2f} s"))
        at = (stamps[-1] - end) * np.median(twist[-NEAR:], axis=0) / 2
        odometry = _with_pose(odometry, len(odometry.stamps), stamps[-1], at)
    return odometry, outages


def _with_pose(odometry: Trajectory, i: int, stamp: float, twist: np.ndarray) -> Trajectory:
    """One pose more, before or behind, a motion away from the first or the last."""
    last = min(i, len(odometry.stamps) - 1)
    yaw = odometry.yaw[last]
    along = _chord(twist) * np.exp(1j * yaw)
    xy = odometry.xy[last] + [along.real, along.imag]
    return Trajectory(
        np.insert(odometry.stamps, i, stamp),
        np.insert(odometry.xy, i, xy, axis=0),
        np.insert(odometry.yaw, i, yaw + twist[2]),
    )


def usual_speeds(trajectory: Trajectory) -> Speeds:
    """The speeds that the robot stays below for four fifths of the time that it moves."""
    dt, distance, turn = between_rows(trajectory)

    def usual(rate: np.ndarray) -> float:
        moving = rate[rate > MOVING]
        return float(np.quantile(moving, USUAL)) if len(moving) else 0.0

    return Speeds(usual(distance / dt), usual(turn / dt))


def unknown_motion(outages: list[Outage], speeds: Speeds, stamps: np.ndarray) -> np.ndarray | None:
    """What is not known of the motion up to each image, as standard deviations; None if nothing.

    In an outage the robot's speed may be off by half the usual one. If both ends are known, the
    whole motion is known, and only the path between them is not (a Brownian bridge).

    **Arguments:**
    - `stamps`: [T] of the images, seconds.

    **Returns:** [T, 3] forward, sideways (metres) and turn (radians); zero where all is known.
    """
    variance = np.zeros((len(stamps), 3))
    rate = np.array([SHARE * speeds.forward] * 2 + [max(SHARE * speeds.turn, MIN_TURN_RATE)])
    for outage in outages:
        edges = np.clip(stamps, outage.begin, outage.end)
        seconds = np.diff(edges, prepend=edges[:1])[:, None]
        share = seconds / (outage.end - outage.begin)
        variance += (rate * seconds) ** 2 * ((1 - share) if outage.bridged else 1)
        variance += 0 if outage.bridged else share * MIN_SIGMA**2
    return np.sqrt(variance) if variance.any() else None


def between_rows(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Seconds, metres and radians (both positive) from each row to the next."""
    distance = np.hypot(*np.diff(trajectory.xy, axis=0).T)
    return np.diff(trajectory.stamps), distance, np.abs(np.diff(trajectory.yaw))


def _stale(trajectory: Trajectory) -> np.ndarray:
    """[n] bool, rows that repeat the pose before while the robot drove on, as the next shows."""
    dt, distance, turn = between_rows(trajectory)
    stale = np.zeros(len(trajectory.stamps), bool)
    still = (distance == 0) & (turn == 0)
    edges = np.diff(np.concatenate([[0], still.astype(int), [0]]))
    period = float(np.median(dt))
    so_far = [np.append(0.0, np.cumsum(step)) for step in (distance, turn)]
    for begin, end in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
        if begin == 0 or end == len(dt):  # no row before or behind to compare with
            continue
        now, seconds = (
            trajectory.stamps[begin],
            trajectory.stamps[end + 1] - trajectory.stamps[begin],
        )
        since = max(now - seconds, trajectory.stamps[0])
        before = [s[begin] - np.interp(since, trajectory.stamps, s) for s in so_far]
        caught_up = any(
            step[end] > CAUGHT_UP * driven * seconds / (now - since) > 0
            for step, driven in zip((distance, turn), before, strict=True)
        )
        if seconds - dt[end] > STALE_PERIODS * period and caught_up:
            stale[begin + 1 : end + 1] = True
    return stale


def _too_far(
    dt: np.ndarray, distance: np.ndarray, turn: np.ndarray, speeds: Speeds, period: float
) -> np.ndarray:
    """[n - 1] bool, steps far longer than the robot's usual speed and that around them allow."""
    around = np.lib.stride_tricks.sliding_window_view
    longer = np.maximum(dt, period)

    def beyond(step: np.ndarray, usual: float, minimum: float, slack: float) -> np.ndarray:
        local = np.median(around(np.pad(step / dt, 3, mode="edge"), 7), axis=1)
        fast = np.maximum(FASTER * np.maximum(usual, local), minimum)
        return step > fast * longer + slack

    return beyond(distance, speeds.forward, SPEED, SLACK_XY) | beyond(
        turn, speeds.turn, TURN_RATE, SLACK_YAW
    )


def _restarts(trajectory: Trajectory) -> np.ndarray:
    """[n - 1] bool, steps that end where odometers begin and come from far away."""
    pose = np.column_stack([trajectory.xy, np.angle(np.exp(1j * trajectory.yaw))])
    at_origin = np.all(np.abs(pose) < ZERO, axis=1)
    _, distance, _ = between_rows(trajectory)
    return at_origin[1:] & ~at_origin[:-1] & (distance > FROM)


def _without(trajectory: Trajectory, jump: np.ndarray) -> Trajectory:
    """The path with the steps marked replaced by the speed of those around them."""
    dt, steps = np.diff(trajectory.stamps), _steps_robot(trajectory)
    known = np.flatnonzero(~jump)
    for i in np.flatnonzero(jump):
        near = known[np.abs(known - i) <= NEAR]
        usual = np.median(steps[near] / dt[near, None], axis=0) if len(near) else np.zeros(3)
        along = _chord(usual * dt[i])
        steps[i] = along.real, along.imag, usual[2] * dt[i]
    yaw = trajectory.yaw[0] + np.append(0.0, np.cumsum(steps[:, 2]))
    c, s = np.cos(yaw[:-1]), np.sin(yaw[:-1])
    moved = np.stack([c * steps[:, 0] - s * steps[:, 1], s * steps[:, 0] + c * steps[:, 1]], axis=1)
    xy = trajectory.xy[0] + np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    return Trajectory(trajectory.stamps, xy, yaw)


def _steps_robot(trajectory: Trajectory) -> np.ndarray:
    """[n - 1, 3] forward, to the left (metres) and turn (radians), in the frame of each row."""
    c, s = np.cos(trajectory.yaw[:-1]), np.sin(trajectory.yaw[:-1])
    dx, dy = np.diff(trajectory.xy, axis=0).T
    return np.stack([c * dx + s * dy, c * dy - s * dx, np.diff(trajectory.yaw)], axis=1)


def _chord(twist: np.ndarray) -> complex:
    """Where an arc [3] (metres, metres, radians) ends, forward + i left."""
    x, y, turn = twist.tolist()
    return (x + 1j * y) * np.exp(0.5j * turn) * np.sinc(turn / (2 * np.pi))
