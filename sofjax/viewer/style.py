"""What all figures are drawn with."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sofjax.io.text import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
else:  # matplotlib is an extra, and slow to import
    Axes = Figure = Any

SIGNATURE = b"Software\0sofjax"  # in the first bytes of every figure

# draws segments [K, 2, 2] by colour, line width, label and drawing order
LineDrawer = Callable[[np.ndarray, str, float, str | None, int], None]


def new_figure(
    size: tuple[float, float], rows: int = 1, columns: int = 1
) -> tuple[Figure, list[Axes]]:
    """A figure apart from pyplot's and the user's, and its axes row by row; `size` in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


def line_drawer(axes: Axes) -> LineDrawer:
    """A function that draws segments [K, 2, 2] as one collection."""
    from matplotlib.collections import LineCollection

    def lines(
        segments: np.ndarray, color: str, width: float, label: str | None, zorder: int
    ) -> None:
        axes.add_collection(
            LineCollection(
                list(segments), colors=color, linewidths=width, label=label, zorder=zorder,
                capstyle="round",
            ),
            autolim=False,
        )  # fmt: skip

    return lines


def hide_spines(axes: Axes, *sides: str) -> None:
    """Leave out the frame on these sides."""
    for side in sides:
        axes.spines[side].set_visible(False)


def save(figure: Figure, path: Path) -> None:
    """Write a PNG whole or not at all; its metadata say that sofjax has written it."""
    with replacing(path) as file:
        figure.savefig(
            file, dpi=150, format="png", bbox_inches="tight", metadata={"Software": "sofjax"}
        )
