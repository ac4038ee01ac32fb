"""All surfaces of a world, painted into one image, the atlas, from which rays take colours."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from sofjax.simulation.world.plan import left_normal
from sofjax.simulation.world.types import World, line_corners, outline, rectangle

TEXELS = 200.0  # per metre, on floors and walls
CEILING_TEXELS = 40.0
FAR_SHRINK = 4  # floor texels that one texel of the floor's second, coarse picture covers
MAX_TEXELS = 40e6  # of the floor's picture; a larger world is painted more coarsely
MARGIN = 2  # texels around every picture, so that interpolation never mixes two pictures
NOISE_SIDE = 1024


@dataclass(frozen=True)
class Picture:
    """Where a surface is in the atlas: metres (a, b) at column, row `origin + texels * (a, b)`."""

    origin: Float[np.ndarray, "2"]
    texels: float


@dataclass(frozen=True)
class Faces:
    """Upright rectangles that stand on the floor: walls, and the sides of boxes."""

    start: Float[np.ndarray, "faces 2"]  # metres, the foot's first end
    along: Float[np.ndarray, "faces 2"]  # unit vector; one sees the face from its left
    length: Float[np.ndarray, "faces"]
    height: Float[np.ndarray, "faces"]
    origin: Float[np.ndarray, "faces 2"]  # of its picture, at `texels`


@dataclass(frozen=True)
class Tops:
    """Level rectangles over the floor: the tops of boxes."""

    rect: Float[np.ndarray, "tops 4"]
    height: Float[np.ndarray, "tops"]
    origin: Float[np.ndarray, "tops 2"]  # of the picture of (0, 0)


@dataclass(frozen=True)
class Atlas:
    """The painted world."""

    image: UInt8[np.ndarray, "rows columns 3"]  # red, green, blue as displayed
    texels: float  # per metre, of all but the coarse floor and the ceiling
    floor: Picture
    far_floor: Picture
    ceiling: Picture
    faces: Faces
    tops: Tops


def paint_atlas(world: World, seed: int = 0) -> Atlas:
    """Paint a world: colours, texture and the light of its lamps."""
    rng = np.random.default_rng([seed, 11])
    noise = grain(rng)
    low, high = world.corridors[:, :2].min(0), world.corridors[:, 2:].max(0)
    size = high - low
    texels = min(TEXELS, float(np.sqrt(MAX_TEXELS / size.prod())))
    light = Light(world)
    sheet = _Sheet(columns=int(size[0] * texels) + 2 * MARGIN + 2)

    floor = _floor(world, low, size, texels)
    _shade(floor, noise, world.look.grain, light.on_grid(low, floor.shape, texels))
    rows, columns = (n // FAR_SHRINK for n in floor.shape[:2])
    cells = floor[: rows * FAR_SHRINK, : columns * FAR_SHRINK]
    cells = cells.reshape(rows, FAR_SHRINK, columns, FAR_SHRINK, 3)
    far = cells.mean(axis=(1, 3), dtype=np.float32).astype(np.uint8)
    ceiling = _ceiling(world, low, size)

    pictures = []
    for picture, scale in ((floor, texels), (far, texels / FAR_SHRINK), (ceiling, CEILING_TEXELS)):
        pictures.append(Picture(sheet.put(picture) - scale * low - 0.5, scale))
    faces = _faces(world, texels, sheet, noise, light)
    tops = _tops(world, texels, sheet, light)
    return Atlas(sheet.image(), texels, *pictures, faces=faces, tops=tops)


class _Sheet:
    """Pictures put side by side on shelves, and the shelves over one another."""

    def __init__(self, columns: int) -> None:
        self._columns = columns
        self._shelf: list[np.ndarray] = []
        self._shelves: list[np.ndarray] = []
        self._used = self._rows = 0

    def put(self, picture: np.ndarray) -> np.ndarray:
        """Add a picture and return the column and row of its first texel."""
        framed = np.pad(picture, ((MARGIN, MARGIN), (MARGIN, MARGIN), (0, 0)), mode="edge")
        if self._used + framed.shape[1] > self._columns:
            self._close()
        place = np.array([self._used + MARGIN, self._rows + MARGIN], float)
        self._shelf.append(framed)
        self._used += framed.shape[1]
        return place

    def _close(self) -> None:
        if self._shelf:
            rows = max(p.shape[0] for p in self._shelf)
            self._columns = max(self._columns, self._used)
            self._shelves += [self._joined(rows)]
            self._rows += rows
        self._shelf, self._used = [], 0

    def _joined(self, rows: int) -> np.ndarray:
        shelf = np.zeros((rows, self._used, 3), np.uint8)
        at = 0
        for picture in self._shelf:
            shelf[: picture.shape[0], at : at + picture.shape[1]] = picture
            at += picture.shape[1]
        return shelf

    def image(self) -> np.ndarray:
        self._close()
        image = np.zeros((self._rows, self._columns, 3), np.uint8)
        row = 0
        for shelf in self._shelves:
            image[row : row + shelf.shape[0], : shelf.shape[1]] = shelf
            row += shelf.shape[0]
        return image


class Light:
    """Brightness of each place of the plan under the lamps; 1 is usual."""

    def __init__(self, world: World) -> None:
        self._centres = (world.lamps[:, :2] + world.lamps[:, 2:]) / 2
        self._lights = world.lamp_light
        self._ceiling = world.ceiling
        middles = (world.corridors[:, :2] + world.corridors[:, 2:]) / 2
        self._usual = 1.0
        self._usual = float(np.median(self.at(middles))) or 1.0

    def at(self, points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
        light = np.full(points.shape[:-1], 0.5)
        for centre, strength in zip(self._centres, self._lights, strict=True):
            squared = ((points - centre) ** 2).sum(-1)
            light += strength * (self._ceiling**2 / (self._ceiling**2 + squared)) ** 2
        return (light / self._usual) ** 0.7

    def on_grid(
        self, low: np.ndarray, shape: tuple[int, ...], texels: float
    ) -> Float[np.ndarray, "rows columns"]:
        """Light on a coarse grid over a picture, some 0.3 m apart; `_shade` fills in between."""
        rows, columns = (max(2, int(n / texels / 0.3) + 1) for n in shape[:2])
        x = low[0] + np.linspace(0, shape[1] / texels, columns)
        y = low[1] + np.linspace(0, shape[0] / texels, rows)
        return self.at(np.stack(np.meshgrid(x, y), axis=-1))


def grain(rng: np.random.Generator) -> Float[np.ndarray, "side side"]:
    """A periodic texture, from coarse mottling to single texels; variance 1."""
    frequency = np.hypot(
        *np.meshgrid(np.fft.fftfreq(NOISE_SIDE), np.fft.rfftfreq(NOISE_SIDE), indexing="ij")
    )
    amplitude = (frequency + 1.5 / NOISE_SIDE) ** -0.9
    amplitude[0, 0] = 0
    spectrum = np.fft.rfft2(rng.standard_normal((NOISE_SIDE, NOISE_SIDE))) * amplitude
    texture = np.fft.irfft2(spectrum)
    return (texture / texture.std()).astype(np.float32)


def _shade(picture: np.ndarray, noise: np.ndarray, amplitude: float, light: np.ndarray) -> None:
    """Multiply a picture, in place, by texture and by light given on a coarse grid."""
    rows, columns = picture.shape[:2]
    row_at = np.linspace(0, light.shape[0] - 1, rows)
    column_at = np.linspace(0, light.shape[1] - 1, columns)
    per_column = np.array([np.interp(column_at, np.arange(light.shape[1]), line) for line in light])
    texture = np.tile(1 + np.float32(amplitude) * noise, (1, columns // NOISE_SIDE + 1))[
        :, :columns
    ]
    for first in range(0, rows, NOISE_SIDE):
        part = slice(first, min(first + NOISE_SIDE, rows))
        below = np.minimum(row_at[part].astype(int), light.shape[0] - 2)
        share = (row_at[part] - below)[:, None]
        lit = per_column[below] * (1 - share) + per_column[below + 1] * share
        factor = texture[: part.stop - first] * lit.astype(np.float32)
        picture[part] = np.clip(picture[part] * factor[..., None], 0, 255)


def paint_area(
    picture: UInt8[np.ndarray, "rows columns 3"],
    corners: Float[np.ndarray, "4 2"],
    colour: Float[np.ndarray, "3"],
) -> None:
    """Paint a convex polygon; the texels on its edges are covered in part.

    **Arguments:**
    - `corners`: in texels, whose middles are whole numbers; counter-clockwise as x and y go.
    """
    low = np.maximum(np.floor(corners.min(0)).astype(int), 0)
    high = np.minimum(np.ceil(corners.max(0)).astype(int) + 1, picture.shape[1::-1])
    if (low >= high).any():
        return
    x, y = (
        np.arange(low[0], high[0], dtype=np.float32),
        np.arange(low[1], high[1], dtype=np.float32),
    )
    cover = np.ones((len(y), len(x)), np.float32)
    following = np.roll(corners, -1, axis=0)
    normals = left_normal(following - corners)
    lengths = np.linalg.norm(normals, axis=1)
    for corner, normal, length in zip(corners, normals, lengths, strict=True):
        if length > 0:
            nx, ny = (normal / length).astype(np.float32)
            offset = np.float32(0.5 - (nx * corner[0] + ny * corner[1]))
            np.minimum(cover, (ny * y + offset)[:, None] + nx * x, out=cover)
    cover = cover.clip(0, 1)[..., None]
    part = picture[low[1] : high[1], low[0] : high[0]]
    part[:] = part + cover * (np.float32(255) * colour.astype(np.float32) - part) + np.float32(0.5)


def _blank(size: np.ndarray, texels: float, colour: np.ndarray) -> np.ndarray:
    columns, rows = np.ceil(size * texels).astype(int)
    return np.full((rows, columns, 3), np.round(255 * np.clip(colour, 0, 1)), np.uint8)


def _floor(world: World, low: np.ndarray, size: np.ndarray, texels: float) -> np.ndarray:
    picture = _blank(size, texels, world.look.floor)
    areas, lines = world.floor_areas, world.floor_lines
    thin = line_corners(lines.endpoints, lines.widths)
    under = [kind == "tone" for kind in areas.kinds]
    order = [
        *((c, k) for c, k, tone in zip(areas.corners, areas.colours, under, strict=True) if tone),
        *zip(thin, lines.colours, strict=True),
        *(
            (c, k)
            for c, k, tone in zip(areas.corners, areas.colours, under, strict=True)
            if not tone
        ),
    ]
    for corners, colour in order:
        paint_area(picture, _counter_clockwise((corners - low) * texels - 0.5), colour)
    return picture


def _counter_clockwise(corners: np.ndarray) -> np.ndarray:
    (x0, y0), (x1, y1) = corners[2] - corners[0], corners[3] - corners[1]
    return corners if x0 * y1 - y0 * x1 > 0 else corners[::-1]


def _ceiling(world: World, low: np.ndarray, size: np.ndarray) -> np.ndarray:
    picture = _blank(size, CEILING_TEXELS, world.look.ceiling)
    for lamp, light in zip(world.lamps, world.lamp_light, strict=True):
        corners = (rectangle(*lamp) - low) * CEILING_TEXELS - 0.5
        paint_area(picture, corners, np.full(3, 0.55 + 0.45 * light))
    return picture


def _faces(world: World, texels: float, sheet: _Sheet, noise: np.ndarray, light: Light) -> Faces:
    """Paint the walls and the sides of the boxes."""
    feet, heights, pictures = [], [], []
    areas = world.wall_areas
    for w, wall in enumerate(world.walls):
        size = np.array([np.linalg.norm(wall[1] - wall[0]), world.ceiling])
        picture = _blank(size, texels, world.look.wall)
        for i in np.flatnonzero(world.wall_of_area == w):
            paint_area(picture, areas.corners[i] * texels - 0.5, areas.colours[i])
        along = (wall[1] - wall[0]) / size[0]
        off = wall[0] + 0.2 * left_normal(along)
        steps = np.linspace(0, size[0], max(2, int(size[0] / 0.3)))
        aspect = 1.0 if abs(along[0]) > 0.5 else 0.86  # walls across the light are darker
        on_wall = aspect * light.at(off + steps[:, None] * along)
        _shade(picture, noise, 0.3 * world.look.grain, np.outer([0.9, 1.05], on_wall))
        feet.append(wall)
        heights.append(world.ceiling)
        pictures.append(picture)
    for box, colour in zip(world.boxes, lit_boxes(world, light), strict=True):
        for edge, aspect in zip(outline(box[:4]), (0.75, 0.9, 0.8, 1.0), strict=True):
            size = np.array([np.linalg.norm(edge[1] - edge[0]), box[4]])
            feet.append(edge[::-1])  # a box is seen from outside
            heights.append(box[4])
            pictures.append(_blank(size, texels, aspect * colour))
    feet_array = np.array(feet)
    along = feet_array[:, 1] - feet_array[:, 0]
    length = np.linalg.norm(along, axis=1)
    origins = np.array([sheet.put(picture) for picture in pictures]) - 0.5
    return Faces(feet_array[:, 0], along / length[:, None], length, np.array(heights), origins)


def lit_boxes(world: World, light: Light) -> Float[np.ndarray, "boxes 3"]:
    middles = (world.boxes[:, :2] + world.boxes[:, 2:4]) / 2
    return world.box_colours * light.at(middles)[:, None]


def _tops(world: World, texels: float, sheet: _Sheet, light: Light) -> Tops:
    origins = []
    for box, colour in zip(world.boxes, lit_boxes(world, light), strict=True):
        picture = _blank(box[2:4] - box[:2], texels, 1.15 * colour)
        origins.append(sheet.put(picture) - 0.5 - texels * box[:2])
    return Tops(world.boxes[:, :4], world.boxes[:, 4], np.array(origins, float).reshape(-1, 2))
