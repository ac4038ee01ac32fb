"""What a fit of the camera rests on: where the corners lie, and what it leaves of them."""

from pathlib import Path

import numpy as np

from sofjax.viewer.style import line_drawer, new_figure, save

USED, DROPPED = "#1f4e9c", "#d4447c"
ARROW = 0.04  # of the image's width, that the largest usual residual is drawn


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
    width, height = size
    sheet, (image, scatter, bars) = new_figure((15.0, 4.9), 1, 3)
    error = [float(np.sqrt(np.mean(np.sum(r**2, axis=1)))) for r in residuals]
    fitted = np.concatenate([r for r, u in zip(residuals, used, strict=True) if u])
    usual = max(float(np.quantile(np.hypot(*fitted.T), 0.99)), 1e-9)

    scale = ARROW * width / usual
    for points, residual, good in zip(corners, residuals, used, strict=True):
        color = USED if good else DROPPED
        image.plot(*points.T, ".", color=color, ms=2.5, zorder=3)
        if good:
            arrows = np.stack([points, points + scale * residual], axis=1)
            line_drawer(image)(arrows, "#e08e0b", 0.9, None, 2)
    image.set_xlim(-0.5, width - 0.5)
    image.set_ylim(height - 0.5, -0.5)
    image.set_aspect("equal")
    image.set_title(f"corners in the image; residuals {scale:.0f} times", loc="left", fontsize=9)
    image.set_xlabel("x, pixels")
    image.set_ylabel("y, pixels")

    for residual, good in zip(residuals, used, strict=True):
        if not good:
            scatter.plot(*residual.T, ".", color=DROPPED, ms=2, zorder=2)
    scatter.plot(*fitted.T, ".", color=USED, ms=2, zorder=3)
    rms = float(np.sqrt(np.mean(np.sum(fitted**2, axis=1))))
    angle = np.linspace(0, 2 * np.pi, 100)
    scatter.plot(rms * np.cos(angle), rms * np.sin(angle), color="black", lw=1, zorder=4)
    reach = 1.6 * usual
    scatter.set_xlim(-reach, reach)
    scatter.set_ylim(reach, -reach)
    scatter.set_aspect("equal")
    scatter.set_title(f"residuals; root mean square {rms:.3f} px", loc="left", fontsize=9)
    scatter.set_xlabel("x, pixels")
    scatter.set_ylabel("y, pixels")

    order = np.arange(len(names))
    bars.bar(order, error, color=[USED if u else DROPPED for u in used], width=0.7)
    bars.set_ylim(0, 1.2 * max(e for e, u in zip(error, used, strict=True) if u))
    for i, (e, good) in enumerate(zip(error, used, strict=True)):
        if not good:
            bars.text(i, 0.98, f"left out, {e:.2f} px ", rotation=90, ha="center", va="top",
                      fontsize=7, color="white", transform=bars.get_xaxis_transform())  # fmt: skip
    few = order[:: max(1, -(-len(names) // 24))]
    bars.set_xticks(few, [names[i] for i in few], rotation=90, fontsize=7)
    bars.set_title("root mean square of each view, pixels", loc="left", fontsize=9)

    for axes in (image, scatter, bars):
        axes.grid(color="#e6e9ec", lw=0.6)
        axes.set_axisbelow(True)
        for side in ("top", "right"):
            axes.spines[side].set_visible(axes is image)
    sheet.suptitle(title, fontsize=10, ha="left", x=0.01)
    save(sheet, path)
