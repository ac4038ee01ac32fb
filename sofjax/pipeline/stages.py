"""What one stage of a run hands to the next: the drive as the filter left it, and as solved."""

from dataclasses import dataclass

import numpy as np

from sofjax.io.drive import Drive
from sofjax.io.trajectory import Trajectory
from sofjax.pipeline.run_log import RunLog
from sofjax.pipeline.settings import RunSettings
from sofjax.segment_map import FinalMap
from sofjax.slam.state import SlamState


@dataclass(frozen=True)
class Driven:
    """A drive that the filter has come through, before anything is solved for."""

    drive: Drive
    settings: RunSettings  # as used
    log: RunLog
    state: SlamState | None  # the filter's last; None without an image
    final: FinalMap | None  # the map as the filter left it, on the host
    ended_by: KeyboardInterrupt | OSError | None  # what ended the drive early

    @property
    def interrupted(self) -> bool:
        return self.ended_by is not None


@dataclass
class Closed:
    """What was found after the drive."""

    trajectory: Trajectory
    final: FinalMap
    places: np.ndarray  # [n, 2], where the path's uncertainty is known, metres
    covariances: np.ndarray  # [n, 2, 2], square metres
    report: dict[str, object]  # how it went, for `report.json`
