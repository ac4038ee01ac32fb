"""From a drive's segments to its rig: follow, relate, fit, and repeat with the new one."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from sofjax._checks import check_fields
from sofjax.calibration.assessment import Assessment, ambiguity, assess
from sofjax.calibration.fit import CalibrationResult, FitConfig, fit_rig
from sofjax.calibration.floor_test import FloorTestConfig, lies_on_floor
from sofjax.calibration.pairs import (
    ODOMETER,
    TURNS,
    UNKNOWNS,
    Estimate,
    PairNoise,
    SegmentPairs,
    U,
    expected,
    start_at,
)
from sofjax.calibration.tracks import TrackConfig, follow, relate
from sofjax.extraction.observation import Observation
from sofjax.geometry.camera import Mount
from sofjax.motion import BIAS, MotionModel, without_unread_motions
from sofjax.rig import RIG, Rig

# where to begin: at the mount given, and far from it
STARTS = ((1.0, 0.0), (1.3, 0.14), (0.7, 0.14), (1.3, -0.14), (0.7, -0.14))

CONTRADICTED = 4.0  # standard deviations from which a number that was given is another


def random_only() -> PairNoise:
    """Noise without systematic errors in turning: these are solved for."""
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
    more: tuple[str, ...] = ()  # of UNKNOWNS, free beside those of `fit` where the drive tells them
    starts: tuple[tuple[float, float], ...] = STARTS  # factor of height, radians added to pitch
    search_rounds: int = 10  # from each start, at most
    settled: float = 0.1  # a search ends with a round that moves by less, in units of `_distance`
    refine_rounds: int = 3  # from where most starts end, with the test of the floor
    capacity: int = 2048  # pairs
    # two starts that end within these limits end in the same place
    same_height: float = 0.03  # share of the height
    same_angle: float = 0.01  # radians, of pitch and roll

    def __post_init__(self) -> None:
        check_fields(
            self,
            whole_from={"capacity": 1, "search_rounds": 1, "refine_rounds": 1},
            positive=("settled", "same_height", "same_angle"),
        )
        if not self.starts or not all(0 < factor < np.inf for factor, _ in self.starts):
            raise ValueError(
                "DriveFitConfig.starts must be one or more pairs (factor above 0, radians), "
                f"not {self.starts!r}"
            )


@dataclass(frozen=True)
class DriveFit:
    """A drive's rig from pairs alone."""

    fit: CalibrationResult
    pairs: SegmentPairs  # valid where they were taken for floor
    line: Int[Array, "N"]  # the number of each pair's line
    related: int  # pairs before those off the floor were left out
    free: tuple[str, ...]  # what was fitted in the end
    ends: Float[np.ndarray, "starts 3"]  # height, pitch, roll where each start ended
    agreeing: int  # how many of them ended in the same place
    known: Float[np.ndarray, "17 17"] | None = None  # covariance with the mount free in any case
    # of a fit with all of `DriveFitConfig.more` free: what the drive tells of each by itself
    all_free: Float[np.ndarray, "17 17"] | None = None
    as_given: tuple[
        str, ...
    ] = ()  # what was held, as the drive tells it and does not contradict it
    not_told: tuple[str, ...] = ()  # what was held, as the drive does not tell it

    @property
    def estimate(self) -> Estimate:
        return self.fit.estimate

    @property
    def covariance(self) -> Float[np.ndarray, "17 17"]:
        """The covariance of the fit, plus the spread of where the starts ended."""
        spread = np.zeros((U, U))
        height = float(self.fit.mount.height)
        spread[:3, :3] = np.cov((self.ends / [height, 1, 1]).T, bias=True)
        return np.asarray(self.fit.covariance if self.known is None else self.known) + spread

    def verdict(self, config: DriveFitConfig) -> Assessment:
        """Whether this is an answer, and a sentence on why not."""
        assessment = assess(self.fit, config.fit, self.pairs)
        if assessment.usable and 2 * self.agreeing <= len(self.ends):
            return ambiguity(self.ends)
        return assessment


def fit_drive(given: Rig, log: Observation, config: DriveFitConfig | None = None) -> DriveFit:
    """The rig of one drive; wants float64.

    Each round associates segments anew and then solves with these associations. The rounds begin
    at the given mount and at four others far from it; the answer is where most of them end. Only
    the last rounds test which lines lie on the floor: by a wrong mount the wrong lines seem to lie
    there, and the fit would keep that mount. Then all of `config.more` are freed, and those held
    again that the drive does not tell.

    **Arguments:**
    - `given`: with a rough mount.
    """
    config = config or DriveFitConfig()
    log = without_unread_motions(log)
    searched = [_search(start, log, config) for start in starts(given, config)]
    ends = np.array([_place(found.fit.mount) for found in searched])
    agreeing = (_distance(ends[:, None], ends, config) < 1).all(-1).sum(1)
    best = int(np.lexsort((-np.array([f.pairs.valid.sum() for f in searched]), -agreeing))[0])
    found = searched[best]
    for _ in range(config.refine_rounds):
        found = _round(found.estimate, log, config, test_floor=True)
    if config.more:
        found = _freed(found, log, config)
    return replace(found, ends=ends, agreeing=int(agreeing[best]))


def _freed(found: DriveFit, log: Observation, config: DriveFitConfig) -> DriveFit:
    """The fit in which a number that was given holds until the drive contradicts it.

    Height and the odometer's distance are one gauge: the height holds as long as an odometer that
    errs as odometers do explains the images with it.
    """
    refine = range(config.refine_rounds)

    def solved(start: DriveFit, by: ArrayLike, free: Iterable[str]) -> DriveFit:
        free = tuple(name for name in UNKNOWNS if name in {*free, *TURNS})
        estimate = Estimate(start.estimate.given, jnp.asarray(by))
        return _round(estimate, log, config, test_floor=True, free=free)

    asked = {*config.fit.free, *config.more}
    for _ in refine:
        found = solved(found, found.estimate.by, {*asked, "distance"})
    all_free = np.asarray(found.fit.covariance)
    by, kept = contradicted(found.estimate.by, all_free, found.free)
    before = None
    while kept != before:  # a covariance of few numbers is surer than one of many: ask it again
        before = kept
        found = solved(found, _only(by, {*kept, "distance"}), {*kept, "distance"})
        by, kept = contradicted(found.estimate.by, found.fit.covariance, found.free)
    kept |= set() if "height" in kept else {"distance"}
    by = _only(by, kept)
    for _ in refine:
        found = solved(found, by, kept)
        by = found.estimate.by
    # how well it is known, were it not given: apart from the scale, which no image tells
    free = ({*config.fit.free, *kept}) - {"distance"}
    known = np.array(solved(found, by, free).fit.covariance)
    at = UNKNOWNS.index("distance")
    known[at, at] = found.fit.covariance[at, at]  # for a height that is right
    told = np.diag(all_free) <= np.square(config.fit.limit)
    told |= [name in config.fit.free for name in UNKNOWNS]  # the verdict says how well
    held = {name: told[i] for i, name in enumerate(RIG) if name in asked - kept}
    as_given = tuple(name for name, is_told in held.items() if is_told)
    not_told = tuple(name for name, is_told in held.items() if not is_told)
    return replace(found, known=known, all_free=all_free, as_given=as_given, not_told=not_told)


def _only(by: Float[ArrayLike, "17"], names: set[str]) -> Float[np.ndarray, "17"]:
    """A change of some of the unknowns, and of none of the others."""
    return np.where([name in {*names, *TURNS} for name in UNKNOWNS], np.asarray(by), 0.0)


def contradicted(
    by: Float[ArrayLike, "17"], covariance: Float[ArrayLike, "17 17"], free: tuple[str, ...]
) -> tuple[Float[np.ndarray, "17"], set[str]]:
    """What of a fit must differ from how it was given, for the images to agree.

    Several numbers may explain the same images. So those are set back to zero one after the other,
    the least significant first, that the rest can stand for, until each that is left is
    `CONTRADICTED` standard deviations off. The odometer's errors were not given, and stay.

    **Returns:** the estimate given what was set back, and the names of the rest.
    """
    step, S = np.array(by, float), np.array(covariance, float)
    left = [UNKNOWNS.index(name) for name in free if name not in BIAS]
    while left:
        z = np.abs(step[left]) / np.maximum(np.sqrt(np.diag(S)[left]), 1e-12)
        if z.min() > CONTRADICTED:
            break
        least = left[int(np.argmin(z))]
        gain = S[:, least] / S[least, least]
        step = step - gain * step[least]
        S = S - np.outer(gain, S[least])
        left.remove(least)
    return step, {UNKNOWNS[i] for i in left}


def starts(given: Rig, config: DriveFitConfig) -> list[Estimate]:
    """The rig, and others that are far from it in height and pitch, where these are free."""
    free = config.fit.free
    there = []
    for factor, added in config.starts:
        by = jnp.zeros(U).at[0].set(jnp.log(factor) if "height" in free else 0.0)
        there.append(start_at(given).moved(by.at[1].set(added if "pitch" in free else 0.0)))
    return there


def _place(mount: Mount) -> Float[np.ndarray, "3"]:
    return np.array([mount.height, mount.pitch, mount.roll], float)


def _distance(
    a: Float[np.ndarray, "*#batch 3"], b: Float[np.ndarray, "*#batch 3"], config: DriveFitConfig
) -> Float[np.ndarray, "*#batch 3"]:
    """How far two places are apart, in shares of what counts as the same place."""
    return np.abs(a - b) / [config.same_height * np.median(b[..., 0]), *[config.same_angle] * 2]


def _search(start: Estimate, log: Observation, config: DriveFitConfig) -> DriveFit:
    """The last of the rounds from one start, which hardly moves the mount."""
    found = _round(start, log, config, test_floor=False)
    for _ in range(config.search_rounds - 1):
        before = _place(found.fit.mount)
        found = _round(found.estimate, log, config, test_floor=False)
        if (_distance(before, _place(found.fit.mount), config) < config.settled).all():
            break
    return found


def _round(
    estimate: Estimate,
    log: Observation,
    config: DriveFitConfig,
    test_floor: bool,
    free: tuple[str, ...] | None = None,
) -> DriveFit:
    """Follow, relate and fit, once."""
    free = config.fit.free if free is None else free
    # by the motion as it was read: lines followed by an estimated error would confirm the error
    unbiased = Estimate(estimate.given, estimate.by.at[ODOMETER].set(0.0))
    track = follow(config.track, unbiased, log)
    height = float(estimate.rig.mount.height)
    pairs, line = relate(config.track, log, track, height, config.capacity)
    pairs = eqx.tree_at(lambda p: p.sigma, pairs, expected(config.noise, estimate, pairs))
    related = int(pairs.valid.sum())
    if test_floor:
        floor = lies_on_floor(config.floor, estimate, pairs, line)
        pairs = eqx.tree_at(lambda p: p.valid, pairs, floor)
    fit = fit_rig(estimate, pairs, replace(config.fit, free=free))
    return DriveFit(fit, pairs, line, related, free, np.zeros((0, 3)), 0)
