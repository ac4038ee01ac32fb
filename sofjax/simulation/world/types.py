"""The parts of a corridor, and its true segments."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from sofjax.simulation.world.plan import left_normal, wall_directions


@dataclass(frozen=True)
class Areas:
    """Convex polygons painted on a plane, later ones over earlier ones."""

    corners: Float[np.ndarray, "n 4 2"]  # metres
    colours: Float[np.ndarray, "n 3"]  # red, green, blue as seen under even light, 0 to 1
    kinds: tuple[str, ...]


@dataclass(frozen=True)
class FloorLines:
    """Narrow lines painted on the floor: joints of tiles, planks and slabs."""

    endpoints: Float[np.ndarray, "n 2 2"]  # of the centre line, metres
    widths: Float[np.ndarray, "n"]  # metres
    colours: Float[np.ndarray, "n 3"]
    kinds: tuple[str, ...]


@dataclass(frozen=True)
class Look:
    """Colours and surfaces."""

    floor: Float[np.ndarray, "3"]
    wall: Float[np.ndarray, "3"]
    ceiling: Float[np.ndarray, "3"]
    grain: float  # amplitude of the floor's texture, share of its brightness
    gloss: float  # share of a lamp's light that the floor mirrors at grazing incidence


@dataclass(frozen=True)
class Segments3D:
    """Straight edges in the world frame."""

    endpoints: Float[np.ndarray, "n 2 3"]  # metres
    contrast: Float[np.ndarray, "n"]  # step of brightness across the edge, 0 to 1
    kinds: tuple[str, ...]


@dataclass(frozen=True)
class World:
    """A corridor: rectangles of floor, walls around them, and what is painted on either.

    What is drawn and what is true come from the same fields: the properties below derive the
    segments from the painted areas.
    """

    name: str
    corridors: Float[
        np.ndarray, "n 4"
    ]  # x_min, y_min, x_max, y_max, metres; the floor is their union
    walls: Float[np.ndarray, "walls 2 2"]  # end points on the floor, the corridor on their left
    ceiling: float  # height, metres
    waypoints: Float[np.ndarray, "points 2"]  # centre line to drive along, metres
    look: Look
    floor_areas: Areas  # corners in the world frame
    floor_lines: FloorLines
    wall_areas: Areas  # corners (along the wall, height), from (0, 0) at the wall's first end
    wall_of_area: Int[np.ndarray, "wall_areas"]  # index into `walls`
    lamps: Float[np.ndarray, "lamps 4"]  # rectangles on the ceiling, as `corridors`
    lamp_light: Float[np.ndarray, "lamps"]  # 1 for a good lamp, 0 for a dead one
    boxes: Float[np.ndarray, "boxes 5"]  # clutter on the floor: a rectangle and its height, metres
    box_colours: Float[np.ndarray, "boxes 3"]

    @cached_property
    def floor_segments(self) -> Segments3D:
        """The truth: foot of the walls, edges of painted areas, centres of narrow lines."""
        floor = brightness(self.look.floor)
        found = _Found()
        for i, wall in enumerate(self.walls):
            found.add("wall", on_plane(wall), abs(self._foot_brightness(i) - floor))
        lines = self.floor_lines
        for line, colour, kind in zip(lines.endpoints, lines.colours, lines.kinds, strict=True):
            found.add(kind, on_plane(line), abs(brightness(colour) - floor))
        areas = self.floor_areas
        for corners, colour, kind in zip(areas.corners, areas.colours, areas.kinds, strict=True):
            for k in OUTLINE[kind]:
                edge = corners[[k, (k + 1) % 4]]
                found.add(kind, on_plane(edge), abs(brightness(colour) - floor))
        for box, colour in zip(self.boxes, self.box_colours, strict=True):
            for edge in outline(box[:4]):
                found.add("box", on_plane(edge), abs(brightness(colour) - floor))
        return found.segments()

    @cached_property
    def off_floor_segments(self) -> Segments3D:
        """Edges that are not on the floor: of doors, boards, rails, lamps, boxes, corners."""
        found = _Found()
        wall_brightness = brightness(self.look.wall)
        areas = self.wall_areas
        directions = wall_directions(self.walls)
        for corners, colour, kind, w in zip(
            areas.corners, areas.colours, areas.kinds, self.wall_of_area, strict=True
        ):
            contrast = abs(brightness(colour) - wall_brightness)
            plan = self.walls[w, 0] + corners[:, :1] * directions[w]
            points = np.concatenate([plan, corners[:, 1:]], axis=1)
            for k in OUTLINE[kind]:
                edge = points[[k, (k + 1) % 4]]
                if edge[:, 2].max() > 0:
                    found.add(kind, edge, contrast)
        for wall in self.walls:
            found.add("corner", upright(wall[0], self.ceiling), 0.05)
        for lamp, light in zip(self.lamps, self.lamp_light, strict=True):
            for edge in outline(lamp):
                found.add("lamp", on_plane(edge, self.ceiling), 0.1 + 0.5 * light)
        for box, colour in zip(self.boxes, self.box_colours, strict=True):
            contrast = abs(brightness(colour) - wall_brightness)
            for edge in outline(box[:4]):
                found.add("box", on_plane(edge, box[4]), contrast)
                found.add("box", upright(edge[0], box[4]), contrast)
        return found.segments()

    @cached_property
    def reflections(self) -> Segments3D:
        """Lamps mirrored in the floor: edges below it that move with the robot."""
        found = _Found()
        for lamp, light in zip(self.lamps, self.lamp_light, strict=True):
            for edge in outline(lamp):
                found.add(
                    "reflection", on_plane(edge, -self.ceiling), 0.1 * self.look.gloss * light
                )
        return found.segments()

    def _foot_brightness(self, wall: int) -> float:
        """Brightness of the wall right over the floor: that of its baseboard, if it has one."""
        for w, kind, colour in zip(
            self.wall_of_area, self.wall_areas.kinds, self.wall_areas.colours, strict=True
        ):
            if w == wall and kind == "baseboard":
                return brightness(colour)
        return brightness(self.look.wall)


# The visible edges of an area: edge k runs from corner k to the next.
OUTLINE = {
    "mark": (0, 1, 2, 3),
    "threshold": (0, 2),
    "stripe": (0, 2),
    "tone": (),
    "baseboard": (2,),
    "door": (1, 2, 3),
    "frame": (1, 2, 3),
    "board": (0, 1, 2, 3),
    "rail": (0, 2),
}


NARROW = ("grout", "plank", "joint")  # kinds of lines whose true segment is their middle


class _Found:
    """Edges as they are collected."""

    def __init__(self) -> None:
        self._edges: list[np.ndarray] = []
        self._contrast: list[float] = []
        self._kinds: list[str] = []

    def add(self, kind: str, endpoints: np.ndarray, contrast: float) -> None:
        self._kinds.append(kind)
        self._edges.append(endpoints)
        self._contrast.append(contrast)

    def segments(self) -> Segments3D:
        edges = np.array(self._edges, float).reshape(-1, 2, 3)
        return Segments3D(edges, np.array(self._contrast, float), tuple(self._kinds))


def brightness(colour: Float[np.ndarray, "3"]) -> float:
    """Grey value of a colour, 0 to 1."""
    return float(colour @ [0.299, 0.587, 0.114])


def rectangle(x0: float, y0: float, x1: float, y1: float) -> Float[np.ndarray, "4 2"]:
    """Corners, counter-clockwise from the lower left."""
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float)


def outline(rect: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4 2 2"]:
    """The four edges of a rectangle x_min, y_min, x_max, y_max."""
    corners = rectangle(*rect)
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def on_plane(edge: Float[np.ndarray, "2 2"], height: float = 0.0) -> Float[np.ndarray, "2 3"]:
    return np.column_stack([edge, np.full(2, height)])


def upright(foot: Float[np.ndarray, "2"], height: float) -> Float[np.ndarray, "2 3"]:
    return np.array([[*foot, 0.0], [*foot, height]])


def line_corners(
    endpoints: Float[np.ndarray, "n 2 2"], widths: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 4 2"]:
    """Corners of the narrow areas that lines of some width cover, counter-clockwise."""
    d = endpoints[:, 1] - endpoints[:, 0]
    half = left_normal(d / np.linalg.norm(d, axis=-1, keepdims=True)) * widths[:, None] / 2
    a, b = endpoints[:, 0], endpoints[:, 1]
    return np.stack([a - half, b - half, b + half, a + half], axis=1)
