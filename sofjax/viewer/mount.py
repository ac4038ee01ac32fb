"""Residuals of a fit, and the floor as projected by the rig as given and as fitted."""

from pathlib import Path

import numpy as np

from sofjax.viewer.style import hide_spines, new_figure, save

OLD, NEW = "#d4447c", "#1f4e9c"
WORDS = ("as given", "as fitted")


def draw_mount(
    path: Path,
    title: str,
    before: np.ndarray,
    after: np.ndarray,
    floors: list[list[np.ndarray]],
    extent: tuple[float, float, float, float],
) -> None:
    """Draw the residuals, and two images laid over each other on the floor.

    **Arguments:**
    - `before`, `after`: [N, 4] distances in pixels as given and as fitted.
    - `floors`: as given and as fitted the floor from above, grey, from two images.
    - `extent`: the smallest and largest x, then y, of these, metres.
    """
    figure, (bars, *views) = new_figure((14.0, 5.2), 1, 3)
    limit = max(4.0, float(np.quantile(np.abs(after), 0.99)) * 1.5)
    bins = np.linspace(-limit, limit, 61).tolist()
    for values, color, name in ((before, OLD, WORDS[0]), (after, NEW, WORDS[1])):
        rms = float(np.sqrt(np.mean(values**2)))
        inside = np.clip(values.ravel(), -limit, limit)
        bars.hist(inside, bins, color=color, alpha=0.6, label=f"{name}: {rms:.2f} px")
    bars.legend(frameon=False, fontsize=9, loc="upper left")
    bars.set_title(f"ends from the other's line, {len(after)} pairs", loc="left", fontsize=9)
    bars.set_xlabel("pixels")
    bars.set_yticks([])
    hide_spines(bars, "top", "right", "left")

    x0, x1, y0, y1 = extent
    for axes, both, name in zip(views, floors, WORDS, strict=True):
        if len(both) == 2:  # red and cyan: grey where the two agree
            picture = np.stack([both[0], both[1], both[1]], axis=-1)
            picture[(picture == 0).any(axis=-1)] = 0  # outside of one of them
            axes.imshow(picture, extent=(y1, y0, x0, x1), aspect="equal")
        axes.set_title(f"the floor from two images, {name}", loc="left", fontsize=9)
        axes.set_xlabel("y, metres")
        axes.set_ylabel("x, metres; coloured where the two do not meet")
    figure.suptitle(title, fontsize=10, ha="left", x=0.01)
    save(figure, path)
