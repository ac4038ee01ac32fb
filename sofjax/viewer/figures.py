"""The map from above, and segments in their images."""

import importlib.util
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sofjax.viewer.style import Axes, hide_spines, line_drawer, new_figure, save

MISSING = "matplotlib is not installed, so there is no figure: pip install 'sofjax[figures]'"

PATH, ODOMETRY, FLOOR, OTHER, TRUTH = "#c0392b", "#e08e0b", "#1f4e9c", "#d4447c", "#b9c0c7"

ONLINE, ENLARGED = "#e6a49c", 10


def available() -> bool:
    """Whether figures can be drawn at all."""
    return importlib.util.find_spec("matplotlib") is not None


@dataclass(frozen=True)
class MapFigure:
    """What `draw_map` draws, all in one frame, metres."""

    robot: np.ndarray  # [n, 2] positions
    odometry: np.ndarray  # [n, 2]
    segments: np.ndarray  # [K, 2, 2] end points
    true_robot: np.ndarray | None = None  # [n, 2]
    true_segments: np.ndarray | None = None  # [K, 2, 2]
    online: np.ndarray | None = None  # [n, 2] as estimated while driving, if `robot` is smoothed
    ellipses: tuple[np.ndarray, np.ndarray] | None = None  # centres [n, 2], covariances [n, 2, 2]


def draw_map(path: Path, title: str, what: MapFigure) -> None:
    """Draw the path and the map as a PNG; ellipses are drawn ten times as large."""
    known = [what.robot, what.odometry, *what.segments]
    if what.true_robot is not None:
        known.append(what.true_robot)
    low, high = _bounds(known)
    width, height = high - low
    scale = min(8.0 / width, 8.0 / height)  # inches a metre
    size = (max(3.0, scale * width) + 3.2, max(3.0, scale * height) + 0.9)
    figure, (axes,) = new_figure(size)
    lines = line_drawer(axes)
    if what.true_segments is not None:
        lines(what.true_segments, TRUTH, 3.0, "true segments on the floor", 1)
    if what.true_robot is not None:
        axes.plot(*what.true_robot.T, color="#7f8a94", lw=3.0, zorder=2, label="true path")
    lines(what.segments, FLOOR, 1.3, f"map: {len(what.segments)} segments on the floor", 3)
    axes.plot(
        *what.odometry.T, color=ODOMETRY, lw=1.3, ls=(0, (4, 2)), zorder=4, label="odometry alone"
    )
    if what.online is not None:
        axes.plot(*what.online.T, color=ONLINE, lw=1.2, zorder=4, label="estimated while driving")
    axes.plot(*what.robot.T, color=PATH, lw=1.5, zorder=5, label="estimated path")
    if what.ellipses is not None:
        _draw_ellipses(axes, *what.ellipses)
    axes.plot(*what.robot[0], "o", color=PATH, ms=6, zorder=6, label="start")
    axes.plot(*what.robot[-1], "s", color=PATH, ms=6, zorder=6, label="end")

    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.grid(color="#e6e9ec", lw=0.6)
    axes.set_axisbelow(True)
    axes.set_xlabel("x, metres")
    axes.set_ylabel("y, metres")
    axes.set_title(title, loc="left", fontsize=10)
    figure.legend(loc="outside right upper", frameon=False, fontsize=9)
    hide_spines(axes, "top", "right")
    save(figure, path)


def draw_images(
    path: Path,
    title: str,
    names: list[str],
    images: list[np.ndarray],
    floor: list[np.ndarray],
    other: list[np.ndarray],
) -> None:
    """Draw the segments of a few images in two colours, as a PNG.

    **Arguments:**
    - `images`: grey, undistorted.
    - `floor`, `other`: [S, 2, 2] end points for each image, pixels.
    """
    from matplotlib.lines import Line2D

    columns = min(len(images), 3)
    rows = -(-len(images) // columns)
    height, width = images[0].shape
    figure, grid = new_figure((4.2 * columns, 4.2 * rows * height / width + 0.8), rows, columns)
    for axes in grid:
        axes.set_axis_off()
    panels = zip(grid, names, images, floor, other, strict=False)
    for axes, name, image, on, off in panels:
        axes.imshow(image, cmap="gray", vmin=0, vmax=255)
        lines = line_drawer(axes)
        lines(off, OTHER, 1.4, None, 2)
        lines(on, "#2ecc40", 1.8, None, 3)
        axes.set_title(f"{name}: {len(on)} floor, {len(off)} not", fontsize=8)
    handles = [
        Line2D([], [], color="#2ecc40", lw=2, label="moves as the floor does"),
        Line2D([], [], color=OTHER, lw=2, label="does not, or cannot tell"),
    ]
    figure.suptitle(title, fontsize=10)
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    save(figure, path)


def _draw_ellipses(axes: Axes, centres: np.ndarray, covariances: np.ndarray) -> None:
    """Ellipses of one standard deviation, enlarged, as closed curves."""
    circle = np.linspace(0, 2 * np.pi, 41)
    circle = np.stack([np.cos(circle), np.sin(circle)])
    label = f"standard deviation × {ENLARGED}"
    for centre, covariance in zip(centres, covariances, strict=True):
        size, axis = np.linalg.eigh(covariance)
        curve = centre[:, None] + ENLARGED * axis @ (np.sqrt(np.maximum(size, 0))[:, None] * circle)
        axes.plot(*curve, color=PATH, lw=0.7, alpha=0.8, zorder=6, label=label)
        label = None


def _bounds(parts: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right corner of what is drawn, with a margin; never the same point."""
    points = np.concatenate([np.reshape(part, (-1, 2)) for part in parts])
    low, high = points.min(0), points.max(0)
    margin = np.maximum(0.04 * (high - low).max(), 0.2)
    return low - margin, high + margin
