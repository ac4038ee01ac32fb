"""SoF-SLAM, Fig. 6 of the paper: the settings, the state, and one step from image to image."""

from sofjax.slam.fixed_lag import FixedLagConfig as FixedLagConfig
from sofjax.slam.presets import PRESETS as PRESETS
from sofjax.slam.step import FilterConfig as FilterConfig
from sofjax.slam.step import SlamConfig as SlamConfig
from sofjax.slam.step import SlamState as SlamState
from sofjax.slam.step import StepInfo as StepInfo
from sofjax.slam.step import distribute as distribute
from sofjax.slam.step import init as init
from sofjax.slam.step import run as run
from sofjax.slam.step import step as step
