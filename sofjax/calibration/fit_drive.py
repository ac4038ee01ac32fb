"""From a drive's segments to its mount: follow, relate, fit, and again with what was learnt."""

from dataclasses import dataclass, field

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sofjax.calibration.fit import CalibrationResult, FitConfig, fit_mount, verdict
from sofjax.calibration.floor_test import FloorTestConfig, on_floor
from sofjax.calibration.pairs import TURNS, Estimate, PairNoise, Pairs, U, expected, start_at
from sofjax.calibration.tracks import TrackConfig, follow, relate
from sofjax.extraction.observation import Observation
from sofjax.geometry.camera import Camera, Mount
from sofjax.motion import MotionModel, without_unread_motions

# where to begin: at the mount given, and far from it
STARTS = ((1.0, 0.0), (1.3, 0.14), (0.7, 0.14), (1.3, -0.14), (0.7, -0.14))
SEARCH, REFINE = 10, 3  # rounds from each start at most, and from where most of them end
SETTLED = 0.1  # of what is one place: a round that moves by less is the last of a search


def random_only() -> PairNoise:
    """The odometer's systematic errors in turning are solved for: what is left is noise."""
    return PairNoise(odometer=MotionModel(turn_scale_sigma=0.0, curvature_sigma=0.0))


@dataclass(frozen=True)
class DriveFitConfig:
    """All settings of `fit_drive`."""

    track: TrackConfig = field(default_factory=TrackConfig)
    noise: PairNoise = field(default_factory=random_only)
    floor: FloorTestConfig = field(default_factory=FloorTestConfig)
    fit: FitConfig = field(
        default_factory=lambda: FitConfig(free=("height", "pitch", "roll", *TURNS))
    )
    starts: tuple[tuple[float, float], ...] = STARTS  # height times, radians of pitch more
    capacity: int = 4096  # pairs
    same_height: float = 0.03  # share of the height by which two ends are one place
    same_angle: float = 0.01  # radians


@dataclass(frozen=True)
class DriveFit:
    """A drive's mount from pairs alone."""

    fit: CalibrationResult
    pairs: Pairs  # valid where they were taken for floor
    line: Int[Array, "N"]  # the number of each pair's line
    related: int  # pairs before those that are not floor were left out
    ends: Float[np.ndarray, "starts 3"]  # height, pitch, roll where each start ended
    agreeing: int  # how many of them ended in the same place

    @property
    def estimate(self) -> Estimate:
        return Estimate(self.fit.mount, self.fit.odometer)

    @property
    def covariance(self) -> Float[np.ndarray, "8 8"]:
        """That of the fit, and where the starts ended besides."""
        spread = np.zeros((U, U))
        spread[:3, :3] = np.cov(self.ends.T, bias=True)
        return np.asarray(self.fit.covariance) + spread

    def verdict(self, rules: "DriveRules") -> tuple[bool, str]:
        """Whether this is an answer, and a sentence on why not."""
        usable, why = verdict(self.fit, rules.fit, self.pairs)
        starts = len(self.ends)
        if usable and 2 * self.agreeing <= starts:
            (h0, *low), (h1, *high) = self.ends.min(0), self.ends.max(0)
            places = [f"heights {h0:.3f} to {h1:.3f} m"] if h1 > h0 else []
            for name, a, b in zip(("pitch", "roll"), *np.degrees([low, high]), strict=True):
                places += [f"{name} {a:.1f} to {b:.1f}°"] if b > a else []
            usable = False
            why = f"ambiguous: from {starts} starts the fit ends in different places, " + ", ".join(
                places
            )
        return usable, why


def fit_drive(
    camera: Camera, mount: Mount, log: Observation, rules: DriveFitConfig | None = None
) -> DriveFit:
    """The mount of one drive; wants float64.

    Associations stay as they are in a solve and are made anew between two. The rounds begin at
    the given mount and at four others far from it; the answer is where most of them end. Only
    from there lines are told by their height: by a wrong mount it is the wrong ones that seem to
    lie on the floor, and that mount would stay.

    **Arguments:**
    - `mount`: roughly.
    """
    rules = rules or DriveFitConfig()
    log = without_unread_motions(log)
    searched = [_search(camera, start, log, rules) for start in starts(mount, rules)]
    ends = np.array([_place(found.fit.mount) for found in searched])
    agreeing = (_apart(ends[:, None], ends, rules) < 1).all(-1).sum(1)
    best = int(np.lexsort((-np.array([f.pairs.valid.sum() for f in searched]), -agreeing))[0])
    found = searched[best]
    for _ in range(REFINE):
        found = _round(camera, found.estimate, log, rules, tell_floor=True)
    return DriveFit(found.fit, found.pairs, found.line, found.related, ends, int(agreeing[best]))


def starts(mount: Mount, rules: DriveFitConfig) -> list[Mount]:
    """The mount, and others with what is free far from it."""
    free = rules.fit.free
    there = []
    for times, more in rules.starts:
        by = jnp.zeros(U).at[0].set(jnp.log(times) if "height" in free else 0.0)
        there.append(start_at(mount).moved(by.at[1].set(more if "pitch" in free else 0.0)).mount)
    return there


def _place(mount: Mount) -> Float[np.ndarray, "3"]:
    return np.array([mount.height, mount.pitch, mount.roll], float)


def _apart(a, b, rules: DriveFitConfig) -> Float[np.ndarray, "... 3"]:
    """How far two places are apart, in shares of what is one place."""
    return np.abs(a - b) / [rules.same_height * np.median(b[..., 0]), *[rules.same_angle] * 2]


def _search(camera: Camera, mount: Mount, log: Observation, rules: DriveFitConfig) -> DriveFit:
    """Rounds until one hardly moves the mount."""
    found = _round(camera, start_at(mount), log, rules, tell_floor=False)
    for _ in range(SEARCH - 1):
        before = _place(found.fit.mount)
        found = _round(camera, found.estimate, log, rules, tell_floor=False)
        if (_apart(before, _place(found.fit.mount), rules) < SETTLED).all():
            break
    return found


def _round(
    camera: Camera, estimate: Estimate, log: Observation, rules: DriveFitConfig, tell_floor: bool
) -> DriveFit:
    """Follow, relate and fit, once."""
    # as the odometer read: what is followed by an error of it would prove that error
    track = follow(rules.track, camera, start_at(estimate.mount), log)
    pairs, line = relate(rules.track, log, track, float(estimate.mount.height), rules.capacity)
    sigma = expected(rules.noise, camera, estimate, pairs)
    pairs = eqx.tree_at(lambda p: p.sigma, pairs, sigma)
    related = int(pairs.valid.sum())
    if tell_floor:
        floor = on_floor(rules.floor, camera, estimate, pairs, line)
        pairs = eqx.tree_at(lambda p: p.valid, pairs, floor)
    fit = fit_mount(camera, estimate.mount, pairs, rules.fit)
    return DriveFit(fit, pairs, line, related, np.zeros((0, 3)), 0)
