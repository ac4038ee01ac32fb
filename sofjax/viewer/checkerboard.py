"""The corners that a fit of the camera used, and their residuals."""

from pathlib import Path

import numpy as np

from sofjax.viewer.style import Axes, hide_spines, line_drawer, new_figure, save

USED, DROPPED = "#1f4e9c", "#d4447c"
ARROW = 0.04  # share of the image's width, the length of the largest usual residual


def draw_corners(
    path: Path,
    title: str,
    size: tuple[int, int],
    corners: list[np.ndarray],
    residuals: list[np.ndarray],
    used: list[bool],
    names: list[str],
) -> None:
    """Draw the corners in the image, their residuals there and in pixels, and each view's error.

    **Arguments:**
    - `size`: width and height of the images, pixels.
    - `corners`, `residuals`: [N, 2] of each view, pixels; residuals are found minus projected.
    - `used`: which views the fit rests on.
    """
    figure, (image, scatter, bars) = new_figure((15.0, 4.9), 1, 3)
    fitted = np.concatenate([r for r, u in zip(residuals, used, strict=True) if u])
    usual = max(float(np.quantile(np.hypot(*fitted.T), 0.99)), 1e-9)
    _draw_image(image, size, corners, residuals, used, usual)
    _draw_residuals(scatter, residuals, used, usual)
    _draw_errors(bars, residuals, used, names)
    for axes in (image, scatter, bars):
        axes.grid(color="#e6e9ec", lw=0.6)
        axes.set_axisbelow(True)
    hide_spines(scatter, "top", "right")
    hide_spines(bars, "top", "right")
    figure.suptitle(title, fontsize=10, ha="left", x=0.01)
    save(figure, path)


def _draw_image(
    axes: Axes,
    size: tuple[int, int],
    corners: list[np.ndarray],
    residuals: list[np.ndarray],
    used: list[bool],
    usual: float,
) -> None:
    """The corners in the image, with their enlarged residuals where they are used."""
    width, height = size
    scale = ARROW * width / usual
    for points, residual, good in zip(corners, residuals, used, strict=True):
        color = USED if good else DROPPED
        axes.plot(*points.T, ".", color=color, ms=2.5, zorder=3)
        if good:
            arrows = np.stack([points, points + scale * residual], axis=1)
            line_drawer(axes)(arrows, "#e08e0b", 0.9, None, 2)
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_title(f"corners in the image; residuals {scale:.0f} times", loc="left", fontsize=9)
    _in_pixels(axes)


def _draw_residuals(
    axes: Axes, residuals: list[np.ndarray], used: list[bool], usual: float
) -> None:
    """The residuals of all corners in pixels, with a circle of their root mean square."""
    for residual, good in zip(residuals, used, strict=True):
        if not good:
            axes.plot(*residual.T, ".", color=DROPPED, ms=2, zorder=2)
    fitted = np.concatenate([r for r, u in zip(residuals, used, strict=True) if u])
    axes.plot(*fitted.T, ".", color=USED, ms=2, zorder=3)
    rms = float(np.sqrt(np.mean(np.sum(fitted**2, axis=1))))
    angle = np.linspace(0, 2 * np.pi, 100)
    axes.plot(rms * np.cos(angle), rms * np.sin(angle), color="black", lw=1, zorder=4)
    limit = 1.6 * usual
    axes.set_xlim(-limit, limit)
    axes.set_ylim(limit, -limit)
    axes.set_title(f"residuals; root mean square {rms:.3f} px", loc="left", fontsize=9)
    _in_pixels(axes)


def _draw_errors(
    axes: Axes, residuals: list[np.ndarray], used: list[bool], names: list[str]
) -> None:
    """The root mean square of each view's residuals, as bars."""
    error = [float(np.sqrt(np.mean(np.sum(r**2, axis=1)))) for r in residuals]
    order = np.arange(len(names))
    axes.bar(order, error, color=[USED if u else DROPPED for u in used], width=0.7)
    axes.set_ylim(0, 1.2 * max(e for e, u in zip(error, used, strict=True) if u))
    for i, (e, good) in enumerate(zip(error, used, strict=True)):
        if not good:
            axes.text(i, 0.98, f"left out, {e:.2f} px ", rotation=90, ha="center", va="top",
                      fontsize=7, color="white", transform=axes.get_xaxis_transform())  # fmt: skip
    few = order[:: max(1, -(-len(names) // 24))]
    axes.set_xticks(few, [names[i] for i in few], rotation=90, fontsize=7)
    axes.set_title("root mean square of each view, pixels", loc="left", fontsize=9)


def _in_pixels(axes: Axes) -> None:
    """Both axes in pixels, of one scale."""
    axes.set_aspect("equal")
    axes.set_xlabel("x, pixels")
    axes.set_ylabel("y, pixels")
