"""How far a trajectory and a map are from the truth.

The trajectory is moved onto the truth by a rigid motion of the plane, without scale, and the map
goes with it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from sofjax.io.errors import InputError
from sofjax.io.trajectory import Trajectory, gaps

SLACK = 0.06  # seconds that a true pose may lie beyond the estimate's ends
NEAR_IN_TIME = 0.75  # of the usual time between estimates, from one of them; in a gap of theirs
SPACING = 0.02  # metres between the samples of a map ...
SAMPLES = 500_000  # ... of 10 km at most, and further apart in a longer one
PAIRS = 5_000_000_000  # of samples and segments that are compared at most, likewise
NEAR = 0.05  # metres from a true line within which a sample is right ...
PARALLEL = np.deg2rad(5)  # ... if its direction is this near too
TOGETHER = 256  # samples that are compared at once ...
PLACE = 1.0  # ... as they lie within so many metres
IN_SIGHT = 3.0  # metres from the path within which a true line counts as seen


@dataclass(frozen=True)
class RigidMotion:
    """x -> R x + t on the plane."""

    R: np.ndarray  # [2, 2]
    t: np.ndarray  # [2], metres

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Points [..., 2] moved, metres."""
        return points @ self.R.T + self.t

    @property
    def yaw(self) -> float:
        return float(np.arctan2(self.R[1, 0], self.R[0, 0]))


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors of a trajectory after alignment to the truth."""

    coverage: float  # share of the true poses that the estimate spans
    path_m: float  # length of the true path
    ate_m: float  # root mean square distance of the positions
    ate_percent: float  # the same, per cent of the path's length
    max_m: float  # largest distance of a position
    yaw_deg: float  # root mean square error of the heading
    drift_percent: float  # mean end-point error of all stretches of a quarter of the path, per cent
    end_gap_m: float  # end-point error with the first metre alone aligned


@dataclass(frozen=True)
class MapErrors:
    """A map of segments against the true ones."""

    segments: int
    length_m: float
    precision: float  # share of the map's length within 5 cm and 5 degrees of a true segment
    recall: float  # share of the true length within 3 m of the path that the map covers likewise
    error_m: float  # median distance of the map's right samples from the true line


def align(points: np.ndarray, onto: np.ndarray) -> RigidMotion:
    """The rigid motion that moves `points` [n, 2] onto `onto` [n, 2], by least squares."""
    middle, onto_middle = points.mean(0), onto.mean(0)
    U, _, Vt = np.linalg.svd((onto - onto_middle).T @ (points - middle))
    R = U @ np.diag([1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return RigidMotion(R, onto_middle - R @ middle)


def shared(truth: Trajectory, estimate: Trajectory) -> Trajectory:
    """The true poses in the time that the estimate spans, without those in its gaps.

    In a gap an interpolated pose is no estimate.
    """
    begin, end = estimate.stamps[0] - SLACK, estimate.stamps[-1] + SLACK
    span = (truth.stamps >= begin) & (truth.stamps <= end)
    usual = float(np.median(np.diff(estimate.stamps))) if len(estimate.stamps) > 1 else 0.0
    slack = max(SLACK, NEAR_IN_TIME * usual)
    for begin, seconds in gaps(estimate.stamps):
        span &= (truth.stamps <= begin + slack) | (truth.stamps >= begin + seconds - slack)
    if span.sum() < 2:
        raise InputError(
            f"the trajectory ({estimate.span()}) and the true path ({truth.span()}) must share the "
            "time of two poses at least"
        )
    return Trajectory(truth.stamps[span], truth.xy[span], truth.yaw[span])


def evaluate_trajectory(
    truth: Trajectory, estimate: Trajectory
) -> tuple[TrajectoryErrors, RigidMotion]:
    """Errors at the stamps of the truth, and the motion that takes the estimate onto it."""
    true = shared(truth, estimate)
    given = estimate.at(true.stamps)
    motion = align(given.xy, true.xy)
    xy, yaw = motion.apply(given.xy), given.yaw + motion.yaw
    travelled = true.travelled
    length = travelled[-1]

    distance = np.hypot(*(xy - true.xy).T)
    turn = (yaw - true.yaw + np.pi) % (2 * np.pi) - np.pi
    ate = float(np.sqrt(np.mean(distance**2)))
    start = max(5, int(np.searchsorted(travelled, 1.0)))
    end_gap = align(given.xy[:start], true.xy[:start]).apply(given.xy[-1]) - true.xy[-1]
    errors = TrajectoryErrors(
        coverage=len(true.stamps) / len(truth.stamps),
        path_m=float(length),
        ate_m=ate,
        ate_percent=100 * ate / float(length) if length > 0 else float("nan"),
        max_m=float(distance.max()),
        yaw_deg=float(np.degrees(np.sqrt(np.mean(turn**2)))),
        drift_percent=_drift_percent(true, xy, yaw, travelled),
        end_gap_m=float(np.hypot(*end_gap)),
    )
    return errors, motion


def _drift_percent(
    true: Trajectory, xy: np.ndarray, yaw: np.ndarray, travelled: np.ndarray
) -> float:
    """Mean end-point error of the stretches of a quarter of the path, each aligned at its start."""
    stretch = travelled[-1] / 4
    i = np.arange(0, len(xy), max(1, len(xy) // 200))
    j = np.searchsorted(travelled, travelled[i] + stretch)
    i, j = i[j < len(xy)], j[j < len(xy)]
    if stretch == 0 or len(i) == 0:
        return float("nan")
    x, y = (xy[j] - xy[i]).T
    c, s = np.cos(true.yaw[i] - yaw[i]), np.sin(true.yaw[i] - yaw[i])
    given = np.stack([c * x - s * y, s * x + c * y], axis=-1)
    error = np.hypot(*(given - (true.xy[j] - true.xy[i])).T)
    return float(100 * np.mean(error / stretch))


def evaluate_map(
    truth: np.ndarray, segments: np.ndarray, motion: RigidMotion, path: np.ndarray
) -> MapErrors:
    """Precision and recall of a map by length, against the true segments.

    **Arguments:**
    - `truth`: [S, 2, 2], true segments, world frame, metres.
    - `segments`: [K, 2, 2], the map in its own frame, metres.
    - `motion`: from the map's frame to that of the truth, as the trajectory was aligned.
    - `path`: [n, 2], true positions of the robot, metres: what it drove past.
    """
    segments = motion.apply(segments)
    spacing, true_spacing = _spacing(segments, truth), _spacing(truth, segments)
    points, angles = sample(segments, spacing)
    distance = _distance_if_near(points, angles, truth)
    right = distance <= NEAR
    true_points, true_angles = (values[::5] for values in sample(truth, true_spacing))
    seen = distance_to_points(true_points, path) < IN_SIGHT
    found = _distance_if_near(true_points, true_angles, segments) <= NEAR
    return MapErrors(
        segments=len(segments),
        length_m=float(len(points) * spacing),
        precision=float(right.mean()) if len(right) else 0.0,
        recall=float(found[seen].mean()) if seen.any() else 0.0,
        error_m=float(np.median(distance[right])) if right.any() else float("nan"),
    )


def _spacing(segments: np.ndarray, others: np.ndarray) -> float:
    """Metres between the samples of the segments: 2 cm, unless they would be too many."""
    max_samples = min(SAMPLES, PAIRS // max(1, len(others)))
    return max(SPACING, float(np.hypot(*(segments[:, 1] - segments[:, 0]).T).sum()) / max_samples)


def sample(segments: np.ndarray, spacing: float = SPACING) -> tuple[np.ndarray, np.ndarray]:
    """Points [P, 2] along the segments [K, 2, 2], and the directions [P] there, radians.

    They are `spacing` metres apart, and two on each segment at least.
    """
    d = segments[:, 1] - segments[:, 0]
    counts = np.maximum(2, (np.hypot(*d.T) / spacing).astype(int))
    owner = np.repeat(np.arange(len(segments)), counts)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    share = (np.arange(len(owner)) - first + 0.5) / counts[owner]
    angles = np.arctan2(d[:, 1], d[:, 0])
    return segments[owner, 0] + share[:, None] * d[owner], angles[owner]


def distance_to_segments(
    points: np.ndarray, angles: np.ndarray, segments: np.ndarray
) -> np.ndarray:
    """[P] metres from each point to the nearest of the segments [S, 2, 2] that runs as it does.

    Infinite where no segment's direction is within 5 degrees.
    """
    d = segments[:, 1] - segments[:, 0]
    length = np.hypot(*d.T)
    start, d, length = (v[length > 1e-6] for v in (segments[:, 0], d, length))
    d = d / length[:, None]
    direction = np.arctan2(d[:, 1], d[:, 0])
    nearest = np.full(len(points), np.inf)
    for part in _parts(len(points), len(d)):
        from_start = points[part, None] - start
        along = np.clip((from_start * d).sum(-1), 0, length)
        away = np.hypot(*np.moveaxis(from_start - along[..., None] * d, -1, 0))
        turn = np.abs((angles[part, None] - direction + np.pi / 2) % np.pi - np.pi / 2)
        nearest[part] = np.where(turn < PARALLEL, away, np.inf).min(axis=1, initial=np.inf)
    return nearest


def _distance_if_near(points: np.ndarray, angles: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """`distance_to_segments` where that is within `NEAR`, and anything beyond it elsewhere.

    Points of about one place are compared at once, with the segments around them alone.
    """
    low, high = segments.min(axis=1) - 2 * NEAR, segments.max(axis=1) + 2 * NEAR
    nearest = np.full(len(points), np.inf)
    order = np.lexsort(np.floor(points / PLACE).T)
    for i in range(0, len(points), TOGETHER):
        part = order[i : i + TOGETHER]
        bottom, top = points[part].min(axis=0), points[part].max(axis=0)
        around = segments[((low <= top) & (high >= bottom)).all(axis=-1)]
        nearest[part] = distance_to_segments(points[part], angles[part], around)
    return nearest


def distance_to_points(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """[P] metres from each point to the nearest of the others [n, 2]."""
    distinct = np.unique(others, axis=0)  # a tree is slow on copies, as of a robot that stands
    return KDTree(distinct).query(points)[0]


def _parts(rows: int, columns: int) -> list[slice]:
    """Slices of the rows whose tables of rows × columns stay within a few megabytes."""
    step = max(1, 100_000 // max(1, columns))
    return [slice(i, i + step) for i in range(0, rows, step)]
