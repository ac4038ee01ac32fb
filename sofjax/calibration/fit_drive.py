"""From a drive's segments to its rig: follow, relate, fit, and repeat with the new one."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

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

JOINED = 0.3  # of what counts as the same place: a start that comes so near another's end ends too
STEPS = 12  # of a round's solver, at most: the next round goes on
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
    more: tuple[str, ...] = ()  # of UNKNOWNS, free beside those of `fit` if contradicted
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
    same: Float[np.ndarray, "agreeing 3"]  # those of them that ended in the same place
    known: Float[np.ndarray, "17 17"] | None = None  # covariance with the mount free in any case
    as_given: tuple[str, ...] = ()  # held: the drive tells them and does not contradict them
    not_told: tuple[str, ...] = ()  # what was held, as the drive does not tell it

    @property
    def estimate(self) -> Estimate:
        return self.fit.estimate

    @property
    def agreeing(self) -> int:
        """How many starts ended in the same place."""
        return len(self.same)

    @property
    def covariance(self) -> Float[np.ndarray, "17 17"]:
        """The covariance of the fit, plus the spread of where the agreeing starts ended."""
        spread = np.zeros((U, U))
        height = float(self.fit.mount.height)
        if len(self.same) > 1:
            spread[:3, :3] = np.cov((self.same / [height, 1, 1]).T, bias=True)
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
    there, and the fit would keep that mount. Then those of `config.more` are freed that the drive
    contradicts as they were given.

    **Arguments:**
    - `given`: with a rough mount.
    """
    config = config or DriveFitConfig()
    log = without_unread_motions(log)
    searched: list[DriveFit] = []
    for start in starts(given, config):
        searched.append(_search(start, log, config, searched))
    ends = np.array([_place(found.fit.mount) for found in searched])
    alike = np.all(_distance(ends[:, None], ends, config) < 1, axis=-1)
    count = np.array([f.pairs.valid.sum() for f in searched])
    best = int(np.lexsort((-count, -alike.sum(1)))[0])
    found = searched[best]
    for _ in range(config.refine_rounds):
        found = _round(found.estimate, log, config, test_floor=True)
    if config.more:
        found = _freed(found, log, config)
    return replace(found, ends=ends, same=ends[np.flatnonzero(alike[best])])


def _freed(found: DriveFit, log: Observation, config: DriveFitConfig) -> DriveFit:
    """The fit in which a number that was given holds until the drive contradicts it.

    Height and the odometer's distance are one gauge: the height holds as long as an odometer that
    errs as odometers do explains the images with it.
    """

    def solved(start: DriveFit, by: ArrayLike, free: Iterable[str]) -> DriveFit:
        free = tuple(name for name in UNKNOWNS if name in {*free, *TURNS})
        estimate = Estimate(start.estimate.given, jnp.asarray(by))
        return _round(estimate, log, config, test_floor=True, free=free)

    mount = {*config.fit.free} - {*TURNS}
    more = {*config.more} - mount
    kept: set[str] = set()
    while tried := _freed_one_by_one(found, config, more - kept):
        name = max(tried, key=lambda name: tried[name].contradicted)
        if tried[name].contradicted < CONTRADICTED:
            break
        kept.add(name)
        found = solved(found, found.estimate.by, mount | kept)
    by, before, kept = found.estimate.by, set(), mount | kept
    while kept != before:
        before = kept
        found = solved(found, _only(by, {*kept, "distance"}), {*kept, "distance"})
        by, kept = contradicted(found.estimate.by, found.fit.covariance, found.free)
    kept |= set() if "height" in kept else {"distance"}
    by = _only(by, kept)
    for _ in range(config.refine_rounds):
        found = solved(found, by, kept)
        by = found.estimate.by
    # how well it is known, were it not given: apart from the scale, which no image tells
    known = np.array(solved(found, by, (mount | kept) - {"distance"}).fit.covariance)
    at = UNKNOWNS.index("distance")
    known[at, at] = found.fit.covariance[at, at]  # for a height that is right
    limit = dict(zip(UNKNOWNS, config.fit.limit, strict=True))
    told = {name for name in tried if tried[name].sigma <= limit[name]} | mount
    held = [name for name in RIG if name in (mount | more) - kept]
    return replace(
        found, known=known,
        as_given=tuple(name for name in held if name in told),  # of the mount the verdict says how
        not_told=tuple(name for name in held if name not in told),
    )  # fmt: skip


def _only(by: Float[ArrayLike, "17"], names: set[str]) -> Float[np.ndarray, "17"]:
    """A change of some of the unknowns, and of none of the others."""
    return np.where([name in {*names, *TURNS} for name in UNKNOWNS], np.asarray(by), 0.0)


class Tried(NamedTuple):
    """One more number of a fit freed."""

    sigma: float  # its standard deviation
    contradicted: float  # standard deviations by which it is another than it was given


def _freed_one_by_one(found: DriveFit, config: DriveFitConfig, names: set[str]) -> dict[str, Tried]:
    """Each of the numbers freed beside those of a fit, with its associations."""
    tried = {}
    for name in sorted(names):
        i = UNKNOWNS.index(name)
        free = replace(config.fit, free=(*found.free, name))
        fit = fit_rig(found.estimate, found.pairs, free, STEPS)
        sigma = max(float(fit.covariance[i, i]) ** 0.5, 1e-12)
        tried[name] = Tried(sigma, abs(float(fit.estimate.by[i])) / sigma)
    return tried


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


def _search(
    start: Estimate, log: Observation, config: DriveFitConfig, others: list["DriveFit"]
) -> DriveFit:
    """The last of the rounds from one start: it moves no more, or comes to where another ended."""
    found = _round(start, log, config, test_floor=False)
    for _ in range(config.search_rounds - 1):
        before = _place(found.fit.mount)
        if any((_distance(before, _place(o.fit.mount), config) < JOINED).all() for o in others):
            break
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
    fit = fit_rig(estimate, pairs, replace(config.fit, free=free), STEPS)
    return DriveFit(fit, pairs, line, related, free, np.zeros((0, 3)), np.zeros((0, 3)))
