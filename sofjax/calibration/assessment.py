"""Whether a fit of the rig is an answer, and what it says, in words for a person."""

import enum
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import optimistix as optx
from jaxtyping import ArrayLike, Float

from sofjax.calibration.fit import DEFAULT, LIMIT, CalibrationResult, FitConfig
from sofjax.calibration.pairs import MOUNT, TURNS, UNKNOWNS, SegmentPairs
from sofjax.motion import BIAS
from sofjax.rig import Rig

SCALE = (
    "only the height over the odometer's distances can be seen: an odometer that reads 1 % too "
    "much makes the height 1 % too large"
)

_HINT = (
    "to see the height, drive some metres (not turning on the spot) over lines that lie across the "
    "path; to see pitch and roll, drive towards such lines until they are near"
)

_DEGREES = ("pitch", "roll", "yaw")
# of each unknown: its name in a sentence, what a unit of the fit is in the unit shown, that unit
_SHOWN = {
    "height": ("height", 100.0, "%"),
    **{name: (name, 180 / np.pi, "°") for name in _DEGREES},
    "x": ("lever arm ahead", 100.0, "% of the height"),
    "y": ("lever arm to the left", 100.0, "% of the height"),
    "focal": ("focal length", 100.0, "%"),
    "cx": ("centre to the right", 100.0, "% of the focal length"),
    "cy": ("centre downwards", 100.0, "% of the focal length"),
    "k1": ("lens's k1", 1.0, ""),
    "k2": ("lens's k2", 1.0, ""),
    "time_offset": ("time offset", 1e3, "ms"),
    "line_delay": ("line delay", 1e6, "µs"),
    "distance": ("odometer's error in distance", 100.0, "%"),
    "left": ("odometer's error in left turns", 100.0, "%"),
    "right": ("odometer's error in right turns", 100.0, "%"),
    "curvature": ("odometer's pull to one side", 180 / np.pi, "° a metre"),
}
_ODOMETER = (
    ("distances", "%"),
    ("left turns", "%"),
    ("right turns", "%"),
    ("turned to the left", "rad / 100 m"),
)
# what a mount must be known to, share of the height and radians, to be called so
GOOD = (0.02, np.radians(0.2))
ROUGH = (LIMIT["height"], LIMIT["pitch"])


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
    limit = dict(zip(UNKNOWNS, config.limit, strict=True))
    # the errors in turning are always free: nobody asked for them
    asked = {name: limit[name] for name in config.free if name not in TURNS}
    if wide := _wide(found.covariance, asked):
        return _not_observable(wide, doubts(found, config))
    if found.result != optx.RESULTS.successful:
        return Assessment.of(FitOutcome.NOT_CONVERGED)
    return Assessment.of(FitOutcome.ANSWER)


def too_wide(covariance: Float[np.ndarray, "17 17"], doubt: str) -> Assessment:
    """That height or angles are known less well than `ROUGH`, and what to drive to mend it."""
    height, angle = ROUGH
    limits = dict(zip(MOUNT[:3], (height, angle, angle), strict=True))
    return _not_observable(_wide(covariance, limits), doubt)


def _wide(covariance: Float[ArrayLike, "17 17"], limits: Mapping[str, float]) -> list[str]:
    """Those of the unknowns that are known less well than their limits, in words."""
    sigma = dict(zip(UNKNOWNS, np.sqrt(np.diag(np.asarray(covariance))).tolist(), strict=True))
    return [
        f"the {_SHOWN[name][0]} (known to {_shown(name, sigma[name])})"
        for name, limit in limits.items()
        if sigma[name] > limit
    ]


def _not_observable(wide: list[str], doubt: str) -> Assessment:
    return Assessment.of(
        FitOutcome.NOT_OBSERVABLE, unknowns=" and ".join(wide), reason=doubt or _HINT
    )


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


def grade(covariance: Float[np.ndarray, "17 17"]) -> str:
    """good, rough or not usable, by how well height and angles are known."""
    sigma = np.sqrt(np.diag(covariance))[:3]
    for word, (height, angle) in (("good", GOOD), ("rough", ROUGH)):
        if (sigma <= (height, angle, angle)).all():
            return word
    return "not usable"


def accuracy(covariance: Float[np.ndarray, "17 17"]) -> str:
    """How well each of height, pitch and roll is known; if none of them is fitted, what is."""
    sigma = dict(zip(UNKNOWNS, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    fitted = [name for name in UNKNOWNS if name not in TURNS and sigma[name]]
    known = [name for name in fitted if name in MOUNT[:3]] or fitted
    said = ", ".join(f"{_SHOWN[name][0]} to {_shown(name, sigma[name])}" for name in known)
    return f"known {said}, apart from the odometer's scale"


def estimates(
    rig: Rig,
    odometer: Float[np.ndarray, "4"],
    covariance: Float[np.ndarray, "17 17"],
    free: tuple[str, ...],
) -> list[str]:
    """What was fitted, each with its standard deviation, and the correlations, as lines of text."""
    sigma = dict(zip(UNKNOWNS, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    m, k = rig.mount, rig.lens.coefficients
    h, f = float(m.height), float(rig.camera.K[0, 0])
    values = {
        "height": (h, h, "m", 4), "x": (m.x, h, "m", 4), "y": (m.y, h, "m", 4),
        **{name: (np.degrees(getattr(m, name)), 180 / np.pi, "°", 2) for name in _DEGREES},
        "focal": (f, f, "px", 2), "cx": (rig.camera.K[0, 2], f, "px", 2),
        "cy": (rig.camera.K[1, 2], f, "px", 2), "k1": (k[0], 1.0, "", 4), "k2": (k[1], 1.0, "", 4),
        "time_offset": (1e3 * rig.time_offset, 1e3, "ms", 1),
        "line_delay": (1e6 * rig.line_delay, 1e6, "µs", 1),
    }  # fmt: skip
    lines = []
    for name, (value, unit, word, digits) in values.items():
        if name not in free:
            continue
        space = "" if word in ("°", "") else " "
        line = f"{name:9} {float(value):.{digits}f} ± {unit * sigma[name]:.{digits}f}{space}{word}"
        radians = f" ({float(getattr(m, name)):.4f} rad)" if name in _DEGREES else ""
        lines.append(line + radians)
    more = [
        f"{words} {100 * float(odometer[i]):+.2f} ± {100 * sigma[BIAS[i]]:.2f} {unit}"
        for i, (words, unit) in enumerate(_ODOMETER)
        if BIAS[i] in free
    ]
    lines += [f"odometer  its readings are to be changed: {', '.join(more)}"] * bool(more)
    shown = [i for i, name in enumerate(UNKNOWNS) if name in MOUNT and name in free and sigma[name]]
    correlations = [
        f"{UNKNOWNS[i]} and {UNKNOWNS[j]} "
        f"{covariance[i, j] / sigma[UNKNOWNS[i]] / sigma[UNKNOWNS[j]]:+.2f}"
        for n, i in enumerate(shown)
        for j in shown[n + 1 :]
    ]
    return lines + [f"correlation  {', '.join(correlations)}"] * bool(correlations)


def _shown(name: str, value: float) -> str:
    """A value in the unit that a person reads, with the unit."""
    _, unit, word = _SHOWN[name]
    space = "" if word[:1] in ("°", "") else " "
    return f"{unit * value:.2g}{space}{word}"
