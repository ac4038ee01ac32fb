"""Errors against the truth as lines for a person."""

import math

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
    table = [("against the truth, aligned without scale", [name for name, _ in columns])]
    for name, label, form in ROWS:
        values = [_number(form, getattr(errors, name)) for _, errors in columns]
        table.append((f"  {label}", values))
    if trajectory.coverage < 0.99:
        table.append(("  share of the true path", [f"{trajectory.coverage:.2f}"]))
    if of_map:
        table += [
            ("  map, precision", [f"{of_map.precision:.2f}"]),
            ("  map, recall", [f"{of_map.recall:.2f}"]),
            ("  map, error", [_number("{:.1f} mm", 1e3 * of_map.error_m)]),
        ]
    width = max(10, 2 + max(len(value) for _, values in table for value in values))
    return [f"  {label:40}" + "".join(f"{v:>{width}}" for v in values) for label, values in table]


def _number(form: str, value: float) -> str:
    """With its unit; a dash for what cannot be said."""
    return form.format(value) if math.isfinite(value) else "-"
