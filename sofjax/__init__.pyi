__version__: str

# the modules, from the ground up
from . import calibration as calibration
from . import evaluation as evaluation
from . import extraction as extraction
from . import geometry as geometry
from . import io as io
from . import likelihood as likelihood
from . import loop_closure as loop_closure
from . import motion as motion
from . import particles as particles
from . import pipeline as pipeline
from . import segment_map as segment_map
from . import simulation as simulation
from . import slam as slam
from . import smoothing as smoothing
from . import viewer as viewer
from . import vision as vision

# the ground: eqs. (1) to (8) and (10) to (13)
from .geometry import SE2 as SE2
from .geometry import Camera as Camera
from .geometry import Mount as Mount
from .geometry import Segments as Segments
from .geometry import floor_homography as floor_homography
from .geometry import floor_to_image as floor_to_image
from .geometry import image_to_floor as image_to_floor
from .geometry import projection_matrix as projection_matrix
from .geometry import two_view_homography as two_view_homography

# segments on the floor: eq. (9) and Fig. 5, for one motion and for many
from .extraction import Association as Association
from .extraction import Observation as Observation
from .extraction import association_scores as association_scores
from .extraction import homographies as homographies
from .extraction import transferred_lines as transferred_lines

# the sensor model of section III.A, for many poses
from .likelihood import LineNoise as LineNoise
from .likelihood import SensorModel as SensorModel
from .likelihood import image_log_likelihood as image_log_likelihood
from .likelihood import log_likelihood as log_likelihood
from .likelihood import log_likelihood_pruned as log_likelihood_pruned

# Fig. 6: the filter
from .motion import MotionModel as MotionModel
from .segment_map import MapConfig as MapConfig
from .slam import PRESETS as PRESETS
from .slam import FilterConfig as FilterConfig
from .slam import FixedLagConfig as FixedLagConfig
from .slam import SlamConfig as SlamConfig
from .slam import SofSlam as SofSlam
from .slam import pose_log_likelihood as pose_log_likelihood
from .slam import shard as shard
