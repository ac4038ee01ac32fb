"""The worlds that have a name."""

import itertools

import numpy as np
from jaxtyping import Float

from sofjax.io.errors import InputError, nearest, quoted
from sofjax.simulation.world.floors import FLOORS, Paint, Plan
from sofjax.simulation.world.furnishing import fit_walls, hang_lamps, put_boxes
from sofjax.simulation.world.plan import distance_to_path, inside, union_walls
from sofjax.simulation.world.types import Look, World

CLEARANCE = 0.35  # metres between the path and a wall


def make_world(name: str, seed: int = 0) -> World:
    """A furnished corridor: its plan by name, what is on its floor and walls by the seed too.

    **Raises:** `InputError` for a name that is not in `WORLDS`.
    """
    if name not in WORLDS:
        raise InputError(f"there is no world {quoted(name)}; {nearest(name, WORLDS)}")
    rng = np.random.default_rng([seed, sorted(WORLDS).index(name)])
    corridors, waypoints, floor = WORLDS[name](rng)
    return furnish(name, corridors, waypoints, floor, rng)


def furnish(
    name: str,
    corridors: Float[np.ndarray, "n 4"],
    waypoints: Float[np.ndarray, "points 2"],
    floor: str,
    rng: np.random.Generator,
) -> World:
    """The furnished world of a bare plan: `floor` is one of `FLOORS`, the rest is random."""
    check_waypoints(corridors, waypoints)
    plan = Plan(corridors, union_walls(corridors), waypoints)
    tint = rng.uniform(0.94, 1.06, 3)
    look = Look(
        floor=np.clip(rng.uniform(0.38, 0.72) * tint, 0, 1),
        wall=np.clip(rng.uniform(0.5, 0.8) * rng.uniform(0.93, 1.07, 3), 0, 1),
        ceiling=np.full(3, rng.uniform(0.1, 0.6)),
        grain=rng.uniform(0.02, 0.05),
        gloss=rng.uniform(0.0, 0.6),
    )
    on_floor = Paint()
    FLOORS[floor](rng, plan, look.floor, on_floor)
    on_walls = fit_walls(rng, plan, look.wall, look.floor, on_floor)
    lamps, lamp_light = hang_lamps(rng, plan)
    boxes, box_colours = put_boxes(rng, plan, int(rng.integers(0, 7)))
    return World(
        name=name,
        corridors=corridors,
        walls=plan.walls,
        ceiling=float(rng.uniform(2.3, 3.0)),
        waypoints=waypoints,
        look=look,
        floor_areas=on_floor.areas(),
        floor_lines=on_floor.lines(),
        wall_areas=on_walls.areas(),
        wall_of_area=np.array(on_walls.walls, int),
        lamps=lamps,
        lamp_light=lamp_light,
        boxes=boxes,
        box_colours=box_colours,
    )


def check_waypoints(
    corridors: Float[np.ndarray, "n 4"], waypoints: Float[np.ndarray, "points 2"]
) -> None:
    """Refuse a path that leaves the corridor or comes too near to a wall."""
    if len(waypoints) < 2:
        raise InputError("a path needs two waypoints at least")
    walls = union_walls(corridors)
    for a, b in itertools.pairwise(waypoints):
        steps = np.linspace(0, 1, max(2, int(np.linalg.norm(b - a) / 0.05)))
        points = a + steps[:, None] * (b - a)
        for outside in points[~inside(corridors, points)][:1]:
            raise InputError(
                f"the path from ({a[0]:g}, {a[1]:g}) to ({b[0]:g}, {b[1]:g}) goes through a wall "
                f"at ({outside[0]:.2f}, {outside[1]:.2f})"
            )
        gaps = np.min([distance_to_path(wall, points) for wall in walls], axis=0)
        if gaps.min() < CLEARANCE:
            near = points[gaps.argmin()]
            raise InputError(
                f"the path comes within {gaps.min():.2f} m of a wall at ({near[0]:.2f}, "
                f"{near[1]:.2f}); a robot needs {CLEARANCE} m"
            )


def around(points: np.ndarray, width: float) -> Float[np.ndarray, "n 4"]:
    """One corridor along each leg of a broken line with legs along the axes."""
    low, high = np.minimum(points[:-1], points[1:]), np.maximum(points[:-1], points[1:])
    return np.concatenate([low - width / 2, high + width / 2], axis=1)


def _paper(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, str]:
    """The paper's loop of 11.5 m × 24 m, clockwise, its begin driven again; section IV.A."""
    loop = np.array([[0, 0], [0, 24], [11.5, 24], [11.5, 0], [0, 0]], float)
    waypoints = np.array([[0, 1], [0, 24], [11.5, 24], [11.5, 0], [0, 0], [0, 8]], float)
    return around(loop, 2.2), waypoints, "blocks"


def _l(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, str]:
    bend = np.array([[0, 0], [0, 9], [8, 9]], float)
    waypoints = np.array([[0, -0.3], [0, 9], [7.6, 9]], float)
    return around(bend, 2.0), waypoints, "tiles"


def _t(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, str]:
    """Up the stem, left, a turn on the spot and along the whole bar."""
    stem, bar = np.array([[0, 0], [0, 8]], float), np.array([[-7, 8], [7, 8]], float)
    waypoints = np.array([[0, 0], [0, 8], [-6.5, 8], [6.5, 8]], float)
    return np.concatenate([around(bar, 2.4), around(stem, 2.2)]), waypoints, "planks"


def _eight(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, str]:
    """Two loops that share the corridor in the middle, which is driven twice."""
    loops = np.array([[0, 0], [9, 0], [9, 16], [0, 16], [0, 0]], float)
    middle = np.array([[0, 8], [9, 8]], float)
    waypoints = [[0, 1], [0, 8], [9, 8], [9, 16], [0, 16], [0, 8], [9, 8], [9, 0], [0, 0], [0, 3]]
    corridors = np.concatenate([around(loops, 2.0), around(middle, 2.0)])
    return corridors, np.array(waypoints, float), "stripes"


def _random(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, str]:
    """A walk on a lattice of corridors, 30 to 60 m, with side corridors left aside."""
    width = rng.uniform(1.7, 2.8)
    xs, ys = (np.cumsum(rng.uniform(width + 2, 11, 5)) for _ in range(2))
    at, heading = rng.integers(0, 5, 2), rng.integers(4)
    steps = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    nodes, travelled, target = [at], 0.0, rng.uniform(30, 60)
    while travelled < target:
        ahead = [t for t in (-1, 0, 1) if _on_lattice(at + steps[(heading + t) % 4])]
        if not ahead:
            heading += 1
            continue
        heading = (heading + rng.choice(ahead)) % 4
        step = steps[heading]
        travelled += abs(xs[at[0] + step[0]] - xs[at[0]]) + abs(ys[at[1] + step[1]] - ys[at[1]])
        at = at + step
        nodes.append(at)
    waypoints = np.array([[xs[i], ys[j]] for i, j in nodes])
    side = np.stack([waypoints[1:-1], waypoints[1:-1]], axis=1)[
        rng.random(len(waypoints) - 2) < 0.3
    ]
    side[:, 1] += steps[rng.integers(0, 4, len(side))] * rng.uniform(1.5, 3.5, (len(side), 1))
    legs = _straight_runs(np.concatenate([np.stack([waypoints[:-1], waypoints[1:]], axis=1), side]))
    corridors = np.concatenate([around(leg, width) for leg in legs])
    return corridors, _corners(waypoints), str(rng.choice(sorted(FLOORS)))


def _on_lattice(node: np.ndarray) -> bool:
    return bool((node >= 0).all() and (node < 5).all())


def _straight_runs(legs: Float[np.ndarray, "n 2 2"]) -> Float[np.ndarray, "m 2 2"]:
    """Legs along the axes, those that continue or repeat one another merged."""
    runs = []
    for axis in (0, 1):
        across = legs[:, 0, 1 - axis]
        mine = legs[:, 0, axis] != legs[:, 1, axis]
        for level in np.unique(across[mine]):
            parts = np.sort(legs[mine & (across == level)][:, :, axis], axis=1)
            parts = parts[np.argsort(parts[:, 0])]
            merged = [parts[0].tolist()]
            for low, high in parts[1:]:
                if low <= merged[-1][1]:
                    merged[-1][1] = max(merged[-1][1], high)
                else:
                    merged.append([low, high])
            for low, high in merged:
                run = np.full((2, 2), level)
                run[:, axis] = low, high
                runs.append(run)
    return np.array(runs)


def _corners(waypoints: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """The points of a broken line at which it bends, with its ends."""
    d = np.sign(np.diff(waypoints, axis=0))
    bends = (d[1:] != d[:-1]).any(axis=1)
    return waypoints[np.concatenate([[True], bends, [True]])]


WORLDS = {"paper": _paper, "l": _l, "t": _t, "eight": _eight, "random": _random}
