"""What a run counts on its way through a drive."""

import itertools
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from sofjax.extraction.observation import Observation
from sofjax.geometry import SE2
from sofjax.io.drive import Drive
from sofjax.io.errors import InputError
from sofjax.io.trajectory import Trajectory
from sofjax.motion import BIAS
from sofjax.pipeline.online import Frame

WARM = 10  # images that timing leaves out: the first one compiles
OF_THE_STEP = (
    "below_horizon",
    "associated",
    "reobserved",
    "matched",
    "initialised",
    "map_overflow",
    "map_truncated",
    "lost",
)


@dataclass
class RunLog:
    """Poses, counts and times of the images done so far."""

    stamps: list[float] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)  # (x, y, yaw), metres, radians
    observations: list[Observation] = field(default_factory=list)  # on the host
    jitter: list[np.ndarray] = field(default_factory=list)  # (pitch, roll), radians
    sensor_inflation: list[float] = field(default_factory=list)  # of the pixels' variance
    odometer_inflation: list[np.ndarray] = field(default_factory=list)  # of (distance, turn)
    floor_side: list[int] = field(default_factory=list)  # segments below the horizon
    trusted: list[bool] = field(default_factory=list)  # the image showed the odometer's motion
    across: list[int] = field(default_factory=list)  # matched lines across the heading
    bias: np.ndarray | None = None  # the odometer's errors at last
    faults: dict[str, list[str]] = field(default_factory=dict)  # files that tell nothing, by why
    without_segments: int = 0  # images that were read and had no segment
    detected: int = 0  # segments
    overflow: int = 0  # segments that found no place in an observation
    step: dict[str, int] = field(default_factory=lambda: dict.fromkeys(OF_THE_STEP, 0))
    doubts: list[str] = field(default_factory=list)  # what they betray about the set-up
    seconds: list[dict[str, float]] = field(default_factory=list)  # of each stage, per image
    done: list[float] = field(default_factory=list)  # clock at the end of each image

    def add(self, drive: Drive, frame: Frame, now: float) -> None:
        """Count the next image of a drive.

        **Arguments:**
        - `now`: the clock at its end, seconds.

        **Raises:** `InputError` if the estimate is not finite.
        """
        view, info = frame.view, frame.info
        i = len(self.stamps)
        pose = np.append(info.T_world_robot.xy, info.T_world_robot.yaw).astype(float)
        if not np.isfinite(pose).all():
            raise InputError(
                f"the estimate is not a number at image {i + 1}, {drive.image_files[i].name}; "
                "some setting is out of all proportion, such as a sigma of zero"
            )
        self.stamps.append(float(drive.image_stamps[i]))
        self.poses.append(pose)
        self.observations.append(jax.device_get(frame.observation))
        self.jitter.append(np.asarray(info.jitter))
        self.sensor_inflation.append(float(info.sensor_inflation))
        self.odometer_inflation.append(np.asarray(info.odometer_inflation))
        self.floor_side.append(int(info.below_horizon))
        self.trusted.append(bool(info.trusted))
        self.across.append(int(info.across))
        self.bias = np.asarray(info.bias)
        if view.fault:
            file = str(drive.image_files[i].relative_to(drive.path))
            self.faults.setdefault(view.fault, []).append(file)
        self.without_segments += view.readable and view.detected == 0
        self.detected += view.detected
        self.overflow += view.overflow
        for name in OF_THE_STEP:
            self.step[name] += int(getattr(info, name))
        self.seconds.append(view.seconds | frame.seconds)
        self.done.append(now)

    @property
    def unreadable(self) -> list[str]:
        """Files that tell nothing, in order."""
        return sorted(itertools.chain(*self.faults.values()))

    @property
    def odometer(self) -> dict[str, float]:
        """The odometer's errors as they were learned at last, by name."""
        return {} if self.bias is None else dict(zip(BIAS, map(float, self.bias), strict=True))

    @property
    def noise(self) -> dict[str, object]:
        """The largest inflation of the variances of sensor and odometer, against the model."""
        distance, turn = np.max([np.ones(2), *self.odometer_inflation], axis=0).tolist()
        return {
            "sensor_inflation": max(self.sensor_inflation, default=1.0),
            "odometer_inflation": {"distance": distance, "turn": turn},
        }

    @property
    def trajectory(self) -> Trajectory:
        """The estimates while driving."""
        poses = np.reshape(self.poses, (-1, 3))
        return Trajectory(np.array(self.stamps), poses[:, :2], np.unwrap(poses[:, 2]))

    @property
    def T_world_robot(self) -> SE2:
        """The estimates, with a leading axis for the images."""
        poses = np.reshape(self.poses, (-1, 3)).astype(np.float32)
        return SE2(jnp.asarray(poses[:, :2]), jnp.asarray(poses[:, 2]))

    @property
    def longest_without_across(self) -> float:
        """The longest path driven without a matched line across the heading, metres."""
        travelled = self.trajectory.travelled
        seen = np.flatnonzero(self.across)
        ends = travelled[[0, *seen, -1]] if len(travelled) else np.zeros(2)
        return float(np.diff(ends).max())

    @property
    def frames_per_second(self) -> float | None:
        """After the first ten images; None in a drive that has no more."""
        n = len(self.done) - WARM
        return n / (self.done[-1] - self.done[WARM - 1]) if n > 0 else None

    def milliseconds(self) -> dict[str, float]:
        """Mean of each stage after the first ten images, or of all if there are no more."""
        seconds = self.seconds[WARM:] or self.seconds
        stages = seconds[0] if seconds else {}
        return {stage: 1e3 * float(np.mean([s[stage] for s in seconds])) for stage in stages}
