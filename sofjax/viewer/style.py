"""What every figure is drawn with."""

from pathlib import Path

from sofjax.io.text import replacing

SIGNATURE = b"Software\0sofjax"  # in the first bytes of every figure


def new_figure(size: tuple[float, float], rows: int = 1, columns: int = 1):
    """A figure of its own, apart from pyplot's and the user's."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns)


def line_drawer(axes):
    """A function that draws segments [K, 2, 2] as one collection."""
    from matplotlib.collections import LineCollection

    def lines(segments, color, width, label, zorder):
        axes.add_collection(
            LineCollection(
                list(segments), colors=color, linewidths=width, label=label, zorder=zorder,
                capstyle="round",
            ),
            autolim=False,
        )  # fmt: skip

    return lines


def save(figure, path: Path) -> None:
    """Write a PNG whole or not at all; its metadata say that sofjax has written it."""
    with replacing(path) as file:
        figure.savefig(
            file, dpi=150, format="png", bbox_inches="tight", metadata={"Software": "sofjax"}
        )
