"""Doors, boards, lamps and boxes of a corridor, at random."""

import numpy as np

from sofjax.simulation.world.floors import Paint, Plan, contrasting
from sofjax.simulation.world.plan import distance_to_path, left_normal, wall_directions
from sofjax.simulation.world.types import rectangle


def fit_walls(
    rng: np.random.Generator, plan: Plan, wall: np.ndarray, floor: np.ndarray, on_floor: Paint
) -> Paint:
    """Baseboards, doors with frames and thresholds, notice boards and rails."""
    on_walls = Paint()
    darker = bool(rng.random() < 0.75)
    baseboard = contrasting(rng, floor, 0.18, 0.35, darker=darker)
    baseboard_height = rng.uniform(0.06, 0.13)
    door = np.array([[0.42, 0.28, 0.18], [0.25, 0.32, 0.42], [0.55, 0.5, 0.42], [0.3, 0.33, 0.3]])
    door = door[rng.integers(4)] * rng.uniform(0.8, 1.2)
    frame = contrasting(rng, wall, 0.1, 0.25)
    threshold = contrasting(rng, floor, 0.1, 0.25)
    with_rail = rng.random() < 0.4
    rail = contrasting(rng, wall, 0.15, 0.35)
    rail_low = rng.uniform(0.75, 0.95)
    directions = wall_directions(plan.walls)
    for w, (start, end) in enumerate(plan.walls):
        length = float(np.linalg.norm(end - start))
        doors = _places(rng, length, 0.9, rng.uniform(1.5, 5.0))
        edges = [0.0, *(s for place in doors for s in place), length]
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            on_walls.area("baseboard", rectangle(a, 0.0, b, baseboard_height), baseboard, w)
            if with_rail and b - a > 0.3:
                on_walls.area("rail", rectangle(a, rail_low, b, rail_low + 0.12), rail, w)
            elif b - a > 1.2 and rng.random() < 0.5:
                s = rng.uniform(a + 0.2, b - 0.8)
                low, size = rng.choice([0.4, 0.9, 1.2, 1.4]), rng.uniform(0.25, 0.7, 2)
                colour = contrasting(rng, wall * rng.uniform(0.6, 1.0, 3), 0.1, 0.4)
                on_walls.area("board", rectangle(s, low, s + size[0], low + size[1]), colour, w)
        for a, b in doors:
            on_walls.area("frame", rectangle(a, 0.0, b, 2.1), frame, w)
            on_walls.area("door", rectangle(a + 0.05, 0.0, b - 0.05, 2.05), door, w)
            if rng.random() < 0.7:
                d = directions[w]
                foot = start + np.outer([a, b], d)
                into = 0.1 * left_normal(d)
                corners = np.stack([foot[0], foot[1], foot[1] + into, foot[0] + into])
                on_floor.area("threshold", corners, threshold)
    return on_walls


def _places(
    rng: np.random.Generator, length: float, width: float, mean_gap: float
) -> list[tuple[float, float]]:
    """Stretches of some width along a wall, with random gaps between them."""
    places = []
    at = rng.uniform(0.5, 0.5 + mean_gap)
    while at + width + 0.4 < length:
        places.append((at, at + width))
        at += width + rng.uniform(1.0, 2 * mean_gap)
    return places


def hang_lamps(rng: np.random.Generator, plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Rectangles on the ceiling along the middle of each corridor, and the light of each."""
    lamps, spacing = [], rng.uniform(2.2, 3.4)
    for i, (x0, y0, x1, y1) in enumerate(plan.corridors):
        along_x = x1 - x0 > y1 - y0
        half = np.array([0.6, 0.15]) if along_x else np.array([0.15, 0.6])
        for a, b in plan.stretches(i, list(range(i))):
            for s in np.arange(a + 1.0, b - 0.7, spacing):
                centre = [s, (y0 + y1) / 2] if along_x else [(x0 + x1) / 2, s]
                lamps.append(np.concatenate([centre - half, centre + half]))
    light = np.where(rng.random(len(lamps)) < 0.1, 0.0, rng.uniform(0.85, 1.0, len(lamps)))
    return np.array(lamps, float).reshape(-1, 4), light


def put_boxes(
    rng: np.random.Generator, plan: Plan, count: int, clearance: float = 0.55
) -> tuple[np.ndarray, np.ndarray]:
    """Clutter beside the walls, clear of the waypoints."""
    boxes, colours = [], []
    for _ in range(count):
        w = rng.integers(len(plan.walls))
        start, end = plan.walls[w]
        length = np.linalg.norm(end - start)
        depth, width = rng.uniform(0.2, 0.4), rng.uniform(0.25, 0.6)
        if length < width + 1.0:
            continue
        d = (end - start) / length
        n = left_normal(d)
        s = rng.uniform(0.5, length - width - 0.5)
        corners = (
            start + np.array([s, s + width])[:, None] * d + np.array([0.02, depth])[:, None] * n
        )
        box = np.concatenate([corners.min(0), corners.max(0)])
        gaps = [np.maximum(box[:2] - other[2:4], other[:2] - box[2:]).max() for other in boxes]
        if (
            distance_to_path(plan.waypoints, rectangle(*box)).min() > clearance
            and min(gaps, default=1) > 0
        ):
            boxes.append(np.append(box, rng.choice([0.3, 0.45, 0.8, 1.5])))
            colours.append(0.6 * rng.uniform(0.1, 0.8) + 0.4 * rng.uniform(0.1, 0.8, 3))
    return np.array(boxes, float).reshape(-1, 5), np.array(colours, float).reshape(-1, 3)
