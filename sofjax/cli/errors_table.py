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
    trajectory: TrajectoryErrors,
    smoothed: TrajectoryErrors | None,
    odometry: TrajectoryErrors | None,
    of_map: MapErrors | None,
) -> list[str]:
    """Lines that set the estimates beside the odometry, and the map below."""
    columns = [("sofjax", trajectory), ("smoothed", smoothed), ("odometry", odometry)]
    columns = [(name, errors) for name, errors in columns if errors]
    heads = "".join(f"{name:>10}" for name, _ in columns)
    lines = [f"  against the truth, aligned without scale{heads}"]
    for name, label, form in ROWS:
        values = "".join(f"{form.format(getattr(errors, name)):>10}" for _, errors in columns)
        lines.append(f"    {label:38}{values}")
    if trajectory.coverage < 0.99:
        lines.append(f"    {'share of the true path':38}{trajectory.coverage:>10.2f}")
    if of_map:
        lines += [
            f"    {'map, precision':38}{of_map.precision:>10.2f}",
            f"    {'map, recall':38}{of_map.recall:>10.2f}",
            f"    {'map, error':38}{1e3 * of_map.error_m:>7.1f} mm",
        ]
    return lines
