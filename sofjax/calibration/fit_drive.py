"""From a drive's segments to its mount: follow, relate, fit, and repeat with the new mount."""

from dataclasses import dataclass, field

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sofjax._checks import check_fields
from sofjax.calibration.assessment import Assessment, ambiguity, assess
from sofjax.calibration.fit import CalibrationResult, FitConfig, fit_mount
from sofjax.calibration.floor_test import FloorTestConfig, lies_on_floor
from sofjax.calibration.pairs import TURNS, Estimate, PairNoise, SegmentPairs, U, expected, start_at
from sofjax.calibration.tracks import TrackConfig, follow, relate
from sofjax.extraction.observation import Observation
from sofjax.geometry.camera import Camera, Mount
from sofjax.motion import MotionModel, without_unread_motions

# where to begin: at the mount given, and far from it
STARTS = ((1.0, 0.0), (1.3, 0.14), (0.7, 0.14), (1.3, -0.14), (0.7, -0.14))


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
    starts: tuple[tuple[float, float], ...] = STARTS  # factor of height, radians added to pitch
    search_rounds: int = 10  # from each start, at most
    settled: float = 0.1  # a search ends with a round that moves by less, in units of `_distance`
    refine_rounds: int = 3  # from where most starts end, with the test of the floor
    capacity: int = 4096  # pairs
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
    """A drive's mount from pairs alone."""

    fit: CalibrationResult
    pairs: SegmentPairs  # valid where they were taken for floor
    line: Int[Array, "N"]  # the number of each pair's line
    related: int  # pairs before those off the floor were left out
    ends: Float[np.ndarray, "starts 3"]  # height, pitch, roll where each start ended
    agreeing: int  # how many of them ended in the same place

    @property
    def estimate(self) -> Estimate:
        return Estimate(self.fit.mount, self.fit.odometer)

    @property
    def covariance(self) -> Float[np.ndarray, "8 8"]:
        """The covariance of the fit, plus the spread of where the starts ended."""
        spread = np.zeros((U, U))
        spread[:3, :3] = np.cov(self.ends.T, bias=True)
        return np.asarray(self.fit.covariance) + spread

    def verdict(self, config: DriveFitConfig) -> Assessment:
        """Whether this is an answer, and a sentence on why not."""
        assessment = assess(self.fit, config.fit, self.pairs)
        if assessment.usable and 2 * self.agreeing <= len(self.ends):
            return ambiguity(self.ends)
        return assessment


def fit_drive(
    camera: Camera, mount: Mount, log: Observation, config: DriveFitConfig | None = None
) -> DriveFit:
    """The mount of one drive; wants float64.

    Each round associates segments anew and then solves with these associations. The rounds begin
    at the given mount and at four others far from it; the answer is where most of them end. Only
    the last rounds test which lines lie on the floor: by a wrong mount the wrong lines seem to lie
    there, and the fit would keep that mount.

    **Arguments:**
    - `mount`: a rough one.
    """
    config = config or DriveFitConfig()
    log = without_unread_motions(log)
    searched = [_search(camera, start, log, config) for start in starts(mount, config)]
    ends = np.array([_place(found.fit.mount) for found in searched])
    agreeing = (_distance(ends[:, None], ends, config) < 1).all(-1).sum(1)
    best = int(np.lexsort((-np.array([f.pairs.valid.sum() for f in searched]), -agreeing))[0])
    found = searched[best]
    for _ in range(config.refine_rounds):
        found = _round(camera, found.estimate, log, config, test_floor=True)
    return DriveFit(found.fit, found.pairs, found.line, found.related, ends, int(agreeing[best]))


def starts(mount: Mount, config: DriveFitConfig) -> list[Mount]:
    """The mount, and others that are far from it in height and pitch, where these are free."""
    free = config.fit.free
    there = []
    for factor, added in config.starts:
        by = jnp.zeros(U).at[0].set(jnp.log(factor) if "height" in free else 0.0)
        there.append(start_at(mount).moved(by.at[1].set(added if "pitch" in free else 0.0)).mount)
    return there


def _place(mount: Mount) -> Float[np.ndarray, "3"]:
    return np.array([mount.height, mount.pitch, mount.roll], float)


def _distance(
    a: Float[np.ndarray, "*#batch 3"], b: Float[np.ndarray, "*#batch 3"], config: DriveFitConfig
) -> Float[np.ndarray, "*#batch 3"]:
    """How far two places are apart, in shares of what counts as the same place."""
    return np.abs(a - b) / [config.same_height * np.median(b[..., 0]), *[config.same_angle] * 2]


def _search(camera: Camera, mount: Mount, log: Observation, config: DriveFitConfig) -> DriveFit:
    """The last of the rounds from one start, which hardly moves the mount."""
    found = _round(camera, start_at(mount), log, config, test_floor=False)
    for _ in range(config.search_rounds - 1):
        before = _place(found.fit.mount)
        found = _round(camera, found.estimate, log, config, test_floor=False)
        if (_distance(before, _place(found.fit.mount), config) < config.settled).all():
            break
    return found


def _round(
    camera: Camera, estimate: Estimate, log: Observation, config: DriveFitConfig, test_floor: bool
) -> DriveFit:
    """Follow, relate and fit, once."""
    # by the motion as it was read: lines followed by an estimated error would confirm the error
    track = follow(config.track, camera, start_at(estimate.mount), log)
    pairs, line = relate(config.track, log, track, float(estimate.mount.height), config.capacity)
    sigma = expected(config.noise, camera, estimate, pairs)
    pairs = eqx.tree_at(lambda p: p.sigma, pairs, sigma)
    related = int(pairs.valid.sum())
    if test_floor:
        floor = lies_on_floor(config.floor, camera, estimate, pairs, line)
        pairs = eqx.tree_at(lambda p: p.valid, pairs, floor)
    fit = fit_mount(camera, estimate.mount, pairs, config.fit)
    return DriveFit(fit, pairs, line, related, np.zeros((0, 3)), 0)
