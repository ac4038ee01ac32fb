"""The patterns of a corridor's floor, at random."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from sofjax.simulation.world.plan import left_normal, offset_walls, parts_inside
from sofjax.simulation.world.types import Areas, FloorLines, brightness, rectangle

BLOCK_WIDTH, BLOCK_SPACING = 0.45, 2.3  # metres; section IV.A


@dataclass
class Paint:
    """Areas and lines as they are collected."""

    corners: list[np.ndarray] = field(default_factory=list)
    colours: list[np.ndarray] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    walls: list[int] = field(default_factory=list)  # of areas on walls
    line_endpoints: list[np.ndarray] = field(default_factory=list)
    line_widths: list[float] = field(default_factory=list)
    line_colours: list[np.ndarray] = field(default_factory=list)
    line_kinds: list[str] = field(default_factory=list)

    def area(self, kind: str, corners: np.ndarray, colour: np.ndarray, wall: int = -1) -> None:
        self.corners.append(corners)
        self.colours.append(colour)
        self.kinds.append(kind)
        self.walls.append(wall)

    def line(self, kind: str, endpoints: np.ndarray, width: float, colour: np.ndarray) -> None:
        self.line_endpoints.append(endpoints)
        self.line_widths.append(width)
        self.line_colours.append(colour)
        self.line_kinds.append(kind)

    def areas(self) -> Areas:
        corners, colours = np.array(self.corners, float), np.array(self.colours, float)
        return Areas(corners.reshape(-1, 4, 2), colours.reshape(-1, 3), tuple(self.kinds))

    def lines(self) -> FloorLines:
        return FloorLines(
            np.array(self.line_endpoints, float).reshape(-1, 2, 2),
            np.array(self.line_widths, float),
            np.array(self.line_colours, float).reshape(-1, 3),
            tuple(self.line_kinds),
        )


def contrasting(
    rng: np.random.Generator,
    colour: np.ndarray,
    low: float,
    high: float,
    darker: bool | None = None,
) -> Float[np.ndarray, "3"]:
    """A colour whose brightness differs from another's by `low` to `high`, darker or lighter."""
    value = brightness(colour)
    if darker is None:
        darker = bool(rng.random() < 0.5)
    if value - low < 0.03:
        darker = False
    if value + low > 0.95:
        darker = True
    step = rng.uniform(low, high) * (-1 if darker else 1)
    grey = np.clip(value + step, 0.03, 0.95)
    return np.clip(grey * rng.uniform(0.95, 1.05, 3), 0, 1)


@dataclass(frozen=True)
class Plan:
    """The bare corridor that is furnished."""

    corridors: Float[np.ndarray, "n 4"]
    walls: Float[np.ndarray, "walls 2 2"]
    waypoints: Float[np.ndarray, "points 2"]

    def stretches(self, i: int, others: list[int]) -> list[tuple[float, float]]:
        """Where corridor `i`, along its length, is not covered by the others."""
        x0, y0, x1, y1 = self.corridors[i]
        axis = 0 if x1 - x0 > y1 - y0 else 1
        low, high = (x0, x1) if axis == 0 else (y0, y1)
        free = [(low, high)]
        for j in others:
            rect = self.corridors[j]
            if rect[0] >= x1 or rect[2] <= x0 or rect[1] >= y1 or rect[3] <= y0:
                continue
            a, b = rect[axis], rect[axis + 2]
            free = [
                p for c, d in free for p in ((c, min(d, a)), (max(c, b), d)) if p[1] - p[0] > 1e-9
            ]
        return free


def blocks(rng: np.random.Generator, plan: Plan, floor: np.ndarray, paint: Paint) -> None:
    """The paper's floor: dark blocks across the corridor, 0.45 m wide, about 2.3 m apart."""
    colour = contrasting(rng, floor, 0.18, 0.35, darker=True)
    for i, (x0, y0, x1, y1) in enumerate(plan.corridors):
        along_x = x1 - x0 > y1 - y0
        middle, width = ((y0 + y1) / 2, y1 - y0) if along_x else ((x0 + x1) / 2, x1 - x0)
        half = min(0.75, 0.36 * width)
        for a, b in plan.stretches(i, [j for j in range(len(plan.corridors)) if j != i]):
            start = a + rng.uniform(0.3, 0.9)
            for near in np.arange(start, b - BLOCK_WIDTH - 0.2, BLOCK_SPACING):
                near = near + rng.normal(0, 0.006)
                along, across = (near, near + BLOCK_WIDTH), (middle - half, middle + half)
                x, y = (along, across) if along_x else (across, along)
                paint.area("mark", rectangle(x[0], y[0], x[1], y[1]), colour)


def tiles(rng: np.random.Generator, plan: Plan, floor: np.ndarray, paint: Paint) -> None:
    """Square tiles along the walls; a narrow joint around each."""
    grid(rng, plan, floor, paint, 0.0, rng.uniform(0.5, 0.7))


def diamonds(rng: np.random.Generator, plan: Plan, floor: np.ndarray, paint: Paint) -> None:
    """Square tiles laid at 45 degrees."""
    grid(rng, plan, floor, paint, np.pi / 4, rng.uniform(0.7, 0.9))


def grid(
    rng: np.random.Generator,
    plan: Plan,
    floor: np.ndarray,
    paint: Paint,
    angle: float,
    spacing: float,
) -> None:
    colour = contrasting(rng, floor, 0.18, 0.32, darker=bool(rng.random() < 0.8))
    width = rng.uniform(0.007, 0.012)
    centre = (plan.corridors[:, :2].min(0) + plan.corridors[:, 2:].max(0)) / 2
    half = np.linalg.norm(plan.corridors[:, 2:].max(0) - plan.corridors[:, :2].min(0)) / 2 + spacing
    centre = centre + rng.uniform(0, spacing, 2)
    for turn in (angle, angle + np.pi / 2):
        d = np.array([np.cos(turn), np.sin(turn)])
        n = left_normal(d)
        for offset in np.arange(-np.ceil(half / spacing), half / spacing) * spacing:
            line = centre + offset * n + np.outer([-half, half], d)
            for part in parts_inside(plan.corridors, line):
                paint.line("grout", part, width, colour)


def planks(rng: np.random.Generator, plan: Plan, floor: np.ndarray, paint: Paint) -> None:
    """Long planks along each corridor, of slightly different tones, with dark seams."""
    seam = contrasting(rng, floor, 0.12, 0.22, darker=True)
    seam_width = rng.uniform(0.005, 0.009)
    wanted = rng.uniform(0.28, 0.45)
    for i, (x0, y0, x1, y1) in enumerate(plan.corridors):
        along_x = x1 - x0 > y1 - y0
        low, high = (y0, y1) if along_x else (x0, x1)
        rows = max(1, round((high - low) / wanted))
        edges = np.linspace(low, high, rows + 1)
        for a, b in plan.stretches(i, list(range(i))):
            for row in range(rows):
                joint = a - rng.uniform(0, 1.5)
                while joint < b:
                    end = joint + rng.uniform(1.4, 2.4)
                    x, y = (max(joint, a), min(end, b)), (edges[row], edges[row + 1])
                    x, y = (x, y) if along_x else (y, x)
                    tone = floor * rng.normal(1, 0.035)
                    paint.area("tone", rectangle(x[0], y[0], x[1], y[1]), np.clip(tone, 0, 1))
                    if a < joint:
                        cross = np.array([[joint, edges[row]], [joint, edges[row + 1]]])
                        paint.line("plank", cross if along_x else cross[:, ::-1], seam_width, seam)
                    joint = end
                if row:
                    seam_line = np.array([[a, edges[row]], [b, edges[row]]])
                    seam_line = seam_line if along_x else seam_line[:, ::-1]
                    paint.line("plank", seam_line, seam_width, seam)


def stripes(rng: np.random.Generator, plan: Plan, floor: np.ndarray, paint: Paint) -> None:
    """A border stripe along the walls; joints across the corridor between long slabs."""
    colour = contrasting(rng, floor, 0.15, 0.35)
    near, width = rng.uniform(0.15, 0.3), rng.uniform(0.06, 0.15)
    inner = offset_walls(plan.corridors, plan.walls, near)
    outer = offset_walls(plan.corridors, plan.walls, near + width)
    for a, b in zip(inner, outer, strict=True):
        if np.linalg.norm(b[1] - b[0]) > 0.3:
            paint.area("stripe", np.stack([a[0], a[1], b[1], b[0]]), colour)
    joint = contrasting(rng, floor, 0.15, 0.3, darker=True)
    spacing, joint_width = rng.uniform(1.8, 3.0), rng.uniform(0.01, 0.03)
    for i, (x0, y0, x1, y1) in enumerate(plan.corridors):
        along_x = x1 - x0 > y1 - y0
        low, high = (y0, y1) if along_x else (x0, x1)
        inset = near + width + 0.02
        for a, b in plan.stretches(i, list(range(i))):
            for s in np.arange(a + rng.uniform(0.5, spacing), b - 0.3, spacing):
                cross = np.array([[s, low + inset], [s, high - inset]])
                paint.line("joint", cross if along_x else cross[:, ::-1], joint_width, joint)


FLOORS = {
    "blocks": blocks, "tiles": tiles, "diamonds": diamonds, "planks": planks, "stripes": stripes,
}  # fmt: skip
