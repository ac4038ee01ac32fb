"""What a fit of the mount says, in lines for a person."""

import numpy as np
from jaxtyping import Float

from sofjax.calibration.pairs import UNKNOWNS
from sofjax.geometry.camera import Mount

_ODOMETER = (
    ("distances", "%"),
    ("left turns", "%"),
    ("right turns", "%"),
    ("turned to the left", "rad / 100 m"),
)
SCALE = (
    "only the height over the odometer's distances can be seen: an odometer that reads 1 % too "
    "much makes the height 1 % too large"
)


def estimates(
    mount: Mount,
    odometer: Float[np.ndarray, "4"],
    covariance: Float[np.ndarray, "8 8"],
    free: tuple[str, ...],
) -> list[str]:
    """What was fitted, each with its standard deviation, and how they hang together."""
    sigma = np.sqrt(np.diag(covariance))
    lines = []
    for i, name in enumerate(UNKNOWNS[:4]):
        if name not in free:
            continue
        if name == "height":
            lines.append(f"height    {float(mount.height):.4f} ± {sigma[i]:.4f} m")
        else:
            value, s = np.degrees([float(getattr(mount, name)), sigma[i]])
            lines.append(f"{name:9} {value:.2f} ± {s:.2f}° ({float(getattr(mount, name)):.4f} rad)")
    more = [
        f"{words} {100 * float(odometer[i]):+.2f} ± {100 * sigma[4 + i]:.2f} {unit}"
        for i, (words, unit) in enumerate(_ODOMETER)
        if UNKNOWNS[4 + i] in free
    ]
    lines += [f"odometer  its readings are to be changed: {', '.join(more)}"] * bool(more)
    shown = [i for i, name in enumerate(UNKNOWNS[:4]) if name in free and sigma[i] > 0]
    together = [
        f"{UNKNOWNS[i]} and {UNKNOWNS[j]} {covariance[i, j] / sigma[i] / sigma[j]:+.2f}"
        for n, i in enumerate(shown)
        for j in shown[n + 1 :]
    ]
    return lines + [f"correlation  {', '.join(together)}"] * bool(together)
