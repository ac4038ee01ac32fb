"""The plan of a corridor: the union of rectangles, the walls around it, what lies inside."""

import itertools

import numpy as np
from jaxtyping import Bool, Float


def union_walls(corridors: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "walls 2 2"]:
    """The walls around a union of rectangles, each as long as it runs straight.

    **Arguments:**
    - `corridors`: x_min, y_min, x_max, y_max of each rectangle, metres.

    **Returns:** end points on the floor, in metres, so directed that the corridor is on the left.
    """
    x = np.unique(corridors[:, [0, 2]])
    y = np.unique(corridors[:, [1, 3]])
    centres = np.stack(np.meshgrid((x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2, indexing="ij"), -1)
    cells = np.pad(inside(corridors, centres), 1)  # cell (i, j) lies left of x[i] and below y[j]
    walls = []
    for j in range(len(y)):
        below, above = cells[1:-1, j], cells[1:-1, j + 1]
        walls += [((x[a], y[j]), (x[b], y[j])) for a, b in _runs(above & ~below)]
        walls += [((x[b], y[j]), (x[a], y[j])) for a, b in _runs(below & ~above)]
    for i in range(len(x)):
        left, right = cells[i, 1:-1], cells[i + 1, 1:-1]
        walls += [((x[i], y[a]), (x[i], y[b])) for a, b in _runs(left & ~right)]
        walls += [((x[i], y[b]), (x[i], y[a])) for a, b in _runs(right & ~left)]
    return np.array(walls, float)


def _runs(flags: Bool[np.ndarray, "n"]) -> list[tuple[int, int]]:
    """First and one past the last index of every run of true."""
    edges = np.flatnonzero(np.diff(np.pad(flags.astype(int), 1)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def inside(
    corridors: Float[np.ndarray, "n 4"], points: Float[np.ndarray, "*batch 2"]
) -> Bool[np.ndarray, "*batch"]:
    """Whether points lie in the union of rectangles."""
    p = points[..., None, :]
    return np.all((p >= corridors[:, :2]) & (p <= corridors[:, 2:]), axis=-1).any(-1)


def left_normal(direction: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    return np.stack([-direction[..., 1], direction[..., 0]], axis=-1)


def wall_directions(walls: Float[np.ndarray, "walls 2 2"]) -> Float[np.ndarray, "walls 2"]:
    d = walls[:, 1] - walls[:, 0]
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def parts_inside(
    corridors: Float[np.ndarray, "n 4"], segment: Float[np.ndarray, "2 2"], shortest: float = 0.1
) -> list[np.ndarray]:
    """The parts of a segment in the union of rectangles, at least `shortest` metres long."""
    start, extent = segment[0], segment[1] - segment[0]
    parts = []
    for x0, y0, x1, y1 in corridors:
        first, last = 0.0, 1.0
        for position, step, low, high in (
            (start[0], extent[0], x0, x1),
            (start[1], extent[1], y0, y1),
        ):
            if abs(step) < 1e-12:
                if not low <= position <= high:
                    last = -1.0
                continue
            a, b = sorted(((low - position) / step, (high - position) / step))
            first, last = max(first, a), min(last, b)
        if first < last:
            parts.append((first, last))
    merged: list[list[float]] = []
    for first, last in sorted(parts):
        if merged and first <= merged[-1][1] + 1e-9:
            merged[-1][1] = max(merged[-1][1], last)
        else:
            merged.append([first, last])
    length = float(np.linalg.norm(extent))
    return [
        start + np.outer(part, extent) for part in merged if (part[1] - part[0]) * length > shortest
    ]


def offset_walls(
    corridors: Float[np.ndarray, "n 4"], walls: Float[np.ndarray, "walls 2 2"], distance: float
) -> Float[np.ndarray, "walls 2 2"]:
    """The walls moved `distance` into the corridor, cut and lengthened so that they meet again."""
    d = wall_directions(walls)
    n = left_normal(d)
    outward = np.stack([-d, d], axis=1)  # at either end, on along the wall
    goes_on = inside(corridors, walls + 1e-3 * (outward + n[:, None]))
    lengthen = np.where(goes_on, distance, -distance)[..., None] * outward
    return walls + distance * n[:, None] + lengthen


def distance_to_path(
    path: Float[np.ndarray, "n 2"], points: Float[np.ndarray, "points 2"]
) -> Float[np.ndarray, "points"]:
    """Distance of points from a broken line, metres."""
    best = np.full(len(points), np.inf)
    for a, b in itertools.pairwise(path):
        d = b - a
        s = np.clip((points - a) @ d / max(d @ d, 1e-12), 0, 1)
        best = np.minimum(best, np.linalg.norm(points - (a + s[:, None] * d), axis=-1))
    return best
