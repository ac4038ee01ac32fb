"""Signs that an odometry as a whole is not as described: its speed and its axes."""

import numpy as np

from sofjax.io.odometry import between_rows
from sofjax.io.trajectory import Trajectory

FASTEST = 60.0  # metres a second; no wheeled robot
STRETCH = 0.1  # metres over which a direction of travel is measured
ONE_LINE = 0.6  # share of the path along one line below which a heading is none
SIDEWAYS = np.deg2rad(30)  # of that line to the heading
BACKWARDS = 0.2  # share driven forward below which the robot drives backwards


def contradictions(
    where: str, lines: np.ndarray, read: Trajectory, mended: Trajectory
) -> list[str]:
    """Sentences on why the odometry as a whole cannot be right.

    **Arguments:** as of `mend`, and what that returned.
    """
    dt, distance, _ = between_rows(read)
    found = []
    speed = distance / dt
    if len(speed) and np.median(speed[distance > 0] if distance.any() else speed) > FASTEST:
        i = int(np.flatnonzero(speed > FASTEST)[0])
        found.append(
            f"{where}, line {lines[i + 1]}: {distance[i]:.4g} m in {dt[i]:.3f} s are "
            f"{speed[i]:.4g} m/s, which no wheeled robot drives; are positions in millimetres?"
        )
    travel = _direction_of_travel(mended)
    if travel is None:
        return found
    one_line, axis, forward = travel
    if one_line < ONE_LINE:
        found.append(
            f"{where}: the heading does not follow the direction of travel; is the yaw in degrees, "
            "of the wrong sign, or are x and y swapped?"
        )
    elif abs(axis) > SIDEWAYS:
        found.append(
            f"{where}: the robot drives {np.degrees(axis):.0f}° to the side of its heading; are x "
            "and y swapped? The heading must be that of the robot's x axis, which points forward"
        )
    elif forward < BACKWARDS:
        found.append(
            f"{where}: the robot drives backwards by its heading; is the sign of x and y or the "
            "heading reversed? The camera must look forward along the robot's x axis"
        )
    return found


def _direction_of_travel(trajectory: Trajectory) -> tuple[float, float, float] | None:
    """Share of the path along one line of the robot's frame, 0 to 1; the angle of that line to
    the heading, radians in (-pi/2, pi/2]; and the share of the path that is driven forward.

    Measured over stretches of `STRETCH` metres, so that a robot that stands and trembles has no
    direction; None for fewer than five.
    """
    xy, chosen = trajectory.xy, [0]
    for i, (x, y) in enumerate(xy.tolist()):
        x0, y0 = xy[chosen[-1]]
        if (x - x0) ** 2 + (y - y0) ** 2 > STRETCH**2:
            chosen.append(i)
    if len(chosen) < 6:
        return None
    dx, dy = np.diff(xy[chosen], axis=0).T
    yaw = trajectory.yaw[chosen]
    along = (dx + 1j * dy) * np.exp(-0.5j * (yaw[:-1] + yaw[1:]))
    distance = np.abs(along)
    line = (along**2 / distance).sum() / distance.sum()  # twice the angle
    forward = distance[along.real > 0].sum() / distance.sum()
    return float(np.abs(line)), float(np.angle(line)) / 2, float(forward)
