"""Whether a fit of the mount is an answer, and what it says, in words for a person."""

import enum
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Float

from sofjax.calibration.fit import DEFAULT, CalibrationResult, FitConfig
from sofjax.calibration.pairs import TURNS, UNKNOWNS, SegmentPairs
from sofjax.geometry.camera import Mount

SCALE = (
    "only the height over the odometer's distances can be seen: an odometer that reads 1 % too "
    "much makes the height 1 % too large"
)

_HINT = (
    "to see the height, drive some metres (not turning on the spot) over lines that lie across the "
    "path; to see pitch and roll, drive towards such lines until they are near"
)

_ODOMETER_ERRORS = {
    "distance": "odometer's error in distance",
    "left": "odometer's error in left turns",
    "right": "odometer's error in right turns",
    "curvature": "odometer's pull to one side",
}

_ODOMETER = (
    ("distances", "%"),
    ("left turns", "%"),
    ("right turns", "%"),
    ("turned to the left", "rad / 100 m"),
)


class FitOutcome(enum.Enum):
    """How a fit of the mount ended; the value is the sentence for the user."""

    ANSWER = "the mount is known"
    TOO_FEW_PAIRS = (
        "{count} pairs of segments on the floor were found, and {needed} are needed: "
        "the drive shows too few lines on the floor, or is too short"
    )
    NOT_OBSERVABLE = "not observable from this drive: {unknowns}; {reason}"
    NOT_CONVERGED = "the fit did not converge"
    AMBIGUOUS = "ambiguous: from {starts} starts the fit ends in different places, {places}"


@dataclass(frozen=True)
class Assessment:
    """The outcome of a fit, and its sentence with this drive's numbers."""

    outcome: FitOutcome
    sentence: str

    @staticmethod
    def of(outcome: FitOutcome, **numbers: object) -> "Assessment":
        """The assessment with the outcome's sentence, filled in with `numbers`."""
        return Assessment(outcome, outcome.value.format(**numbers))

    @property
    def usable(self) -> bool:
        return self.outcome is FitOutcome.ANSWER


def assess(found: CalibrationResult, config: FitConfig, pairs: SegmentPairs) -> Assessment:
    """Whether a fit is an answer, and in words which unknowns the drive does not show."""
    count = int(pairs.valid.sum())
    if count < config.min_pairs:
        return Assessment.of(FitOutcome.TOO_FEW_PAIRS, count=count, needed=config.min_pairs)
    sigma = jnp.sqrt(jnp.diag(found.covariance)).at[0].divide(found.mount.height)
    wide = [
        f"the {_ODOMETER_ERRORS.get(name, name)} ({_accuracy(name, float(s))})"
        for name, s, limit in zip(UNKNOWNS, sigma, config.limit, strict=True)
        # the errors in turning are always free: nobody asked for them
        if name in config.free and name not in TURNS and s > limit
    ]
    if wide:
        return Assessment.of(
            FitOutcome.NOT_OBSERVABLE,
            unknowns=" and ".join(wide),
            reason=doubts(found, config) or _HINT,
        )
    if found.result != optx.RESULTS.successful:
        return Assessment.of(FitOutcome.NOT_CONVERGED)
    return Assessment.of(FitOutcome.ANSWER)


def ambiguity(ends: Float[np.ndarray, "starts 3"]) -> Assessment:
    """That fits from several starts end in different places, and between which values.

    **Arguments:**
    - `ends`: height (metres), pitch and roll (radians) where each start ended.
    """
    (h0, *low), (h1, *high) = ends.min(0), ends.max(0)
    places = [f"heights {h0:.3f} to {h1:.3f} m"] if h1 > h0 else []
    for name, a, b in zip(("pitch", "roll"), *np.degrees([low, high]), strict=True):
        places += [f"{name} {a:.1f} to {b:.1f}°"] if b > a else []
    return Assessment.of(FitOutcome.AMBIGUOUS, starts=len(ends), places=", ".join(places))


def doubts(found: CalibrationResult, config: FitConfig = DEFAULT) -> str:
    """What speaks against a fit that converged, in words; empty if nothing."""
    birge_ratio = float(found.birge_ratio)
    if birge_ratio < config.max_birge_ratio:
        return ""
    return (
        f"the fit needs an odometer whose errors are {birge_ratio:.1f} times those of usual "
        "odometers, so camera, clock or odometer are not what they are taken for; the stated "
        "errors of the mount are wider by the same factor"
    )


def estimates(
    mount: Mount,
    odometer: Float[np.ndarray, "4"],
    covariance: Float[np.ndarray, "8 8"],
    free: tuple[str, ...],
) -> list[str]:
    """What was fitted, each with its standard deviation, and the correlations, as lines of text."""
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
    correlations = [
        f"{UNKNOWNS[i]} and {UNKNOWNS[j]} {covariance[i, j] / sigma[i] / sigma[j]:+.2f}"
        for n, i in enumerate(shown)
        for j in shown[n + 1 :]
    ]
    return lines + [f"correlation  {', '.join(correlations)}"] * bool(correlations)


def _accuracy(name: str, sigma: float) -> str:
    """How well an unknown is known, with its unit."""
    if name in ("height", "distance", "left", "right"):
        return f"known to {100 * sigma:.2g} %"
    if name == "curvature":
        return f"known to {sigma * 57.29578:.2g}° a metre"
    return f"known to {sigma * 57.29578:.2g}°"
