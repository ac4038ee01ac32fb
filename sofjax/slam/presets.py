"""Named settings: what is best, and the paper to the letter."""

from sofjax.extraction.association import Association
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.motion import MotionModel
from sofjax.segment_map import MapConfig
from sofjax.slam.config import FilterConfig, SlamConfig

DEFAULT = SlamConfig()

# Sections II and III as they stand: SoF extracted for every particle from consecutive images,
# one constant sigma, the single winner, eq. (14), no systematic errors, every line on the floor.
PAPER = SlamConfig(
    association=Association(baseline_distance=0.0, baseline_angle=0.0),
    motion=MotionModel(
        turn_noise=0.05,  # the odometer's systematic errors are noise to it
        distance_scale_sigma=0.0,
        turn_scale_sigma=0.0,
        curvature_sigma=0.0,
        slip_rate=0.0,
        adaptation=0.0,
    ),
    sensor=SensorModel(
        propagate=False, rho_sigma=0.05, theta_sigma=0.035, tilt_sigma=0.0, upright=0.0
    ),
    segment_map=MapConfig(
        rule="gamma",
        classify=False,
        rho_drift=0.0,
        theta_drift=0.0,
        merge_distance=0.05,
        min_share=0.0,
    ),
    filter=FilterConfig(choice="winner", gate_each=True, doubts=False),
    lengths="metres",
)

PRESETS = {"default": DEFAULT, "paper": PAPER}
