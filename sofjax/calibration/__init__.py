"""What camera, mount, clock and odometer are, from what is seen while driving."""

from sofjax.calibration.assessment import Assessment as Assessment
from sofjax.calibration.assessment import FitOutcome as FitOutcome
from sofjax.calibration.fit import CalibrationResult as CalibrationResult
from sofjax.calibration.fit import FitConfig as FitConfig
from sofjax.calibration.fit import fit_rig as fit_rig
from sofjax.calibration.fit_drive import DriveFit as DriveFit
from sofjax.calibration.fit_drive import DriveFitConfig as DriveFitConfig
from sofjax.calibration.fit_drive import fit_drive as fit_drive
from sofjax.calibration.pairs import MOUNT as MOUNT
from sofjax.calibration.pairs import TURNS as TURNS
from sofjax.calibration.pairs import UNKNOWNS as UNKNOWNS
from sofjax.calibration.pairs import Estimate as Estimate
from sofjax.calibration.pairs import PairNoise as PairNoise
from sofjax.calibration.pairs import Seen as Seen
from sofjax.calibration.pairs import SegmentPairs as SegmentPairs
from sofjax.calibration.pairs import all_distances as all_distances
from sofjax.calibration.pairs import distances as distances
from sofjax.calibration.pairs import expected as expected
from sofjax.calibration.pairs import start_at as start_at
from sofjax.calibration.tracks import TrackConfig as TrackConfig
from sofjax.calibration.tracks import follow as follow
from sofjax.calibration.tracks import relate as relate
