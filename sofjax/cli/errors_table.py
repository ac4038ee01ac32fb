"""Errors against the truth as lines for a person."""

from sofjax.evaluation import MapErrors, TrajectoryErrors

ROWS = (
    ("ate_m", "position, root mean square", "{:.3f} m"),
    ("ate_percent", "    of the path", "{:.2f} %"),
    ("max_m", "position, largest", "{:.3f} m"),
    ("yaw_deg", "heading, root mean square", "{:.2f}°"),
    ("drift_percent", "drift over a quarter of the path", "{:.2f} %"),
    ("end_gap_m", "end, from the first metre on", "{:.3f} m"),
)


def errors_table(
    trajectory: TrajectoryErrors, odometry: TrajectoryErrors | None, of_map: MapErrors | None
) -> list[str]:
    """Lines that set the estimate beside the odometry, and the map below."""
    head = f"  against the truth, aligned without scale {'sofjax':>9}"
    lines = [head + (f" {'odometry':>10}" if odometry else "")]
    for name, label, form in ROWS:
        line = f"    {label:38} {form.format(getattr(trajectory, name)):>9}"
        if odometry:
            line += f" {form.format(getattr(odometry, name)):>10}"
        lines.append(line)
    if trajectory.coverage < 0.99:
        lines.append(f"    {'share of the true path':38} {trajectory.coverage:>9.2f}")
    if of_map:
        lines += [
            f"    {'map, precision':38} {of_map.precision:>9.2f}",
            f"    {'map, recall':38} {of_map.recall:>9.2f}",
            f"    {'map, error':38} {1e3 * of_map.error_m:>6.1f} mm",
        ]
    return lines
