"""SoF-SLAM, Fig. 6 of the paper: the settings, the state, and one step from image to image."""

from sofjax.slam.config import FilterConfig as FilterConfig
from sofjax.slam.config import FixedLagConfig as FixedLagConfig
from sofjax.slam.config import SlamConfig as SlamConfig
from sofjax.slam.pose_likelihood import pose_log_likelihood as pose_log_likelihood
from sofjax.slam.presets import PRESETS as PRESETS
from sofjax.slam.state import SlamState as SlamState
from sofjax.slam.state import StepInfo as StepInfo
from sofjax.slam.state import shard as shard
from sofjax.slam.step import SofSlam as SofSlam
