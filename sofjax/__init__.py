"""Segments-on-floor monocular SLAM: JAX-vectorised, differentiable; Zhang and Suh's paper and on.

The names below are loaded when they are first used, so that `import sofjax` costs nothing.
"""

import importlib

__version__ = "0.1.0"

_HOME = {  # in reading order
    # the ground: eqs. (1) to (8) and (10) to (13)
    "SE2": "sofjax.geometry",
    "Camera": "sofjax.geometry",
    "Mount": "sofjax.geometry",
    "Segments": "sofjax.geometry",
    "projection_matrix": "sofjax.geometry",
    "floor_homography": "sofjax.geometry",
    "image_to_floor": "sofjax.geometry",
    "floor_to_image": "sofjax.geometry",
    "two_view_homography": "sofjax.geometry",
    # many hypotheses at once
    "homographies": "sofjax.extraction",
    "transferred_lines": "sofjax.extraction",
    "association_scores": "sofjax.extraction",
    "log_likelihood": "sofjax.likelihood",
    "log_likelihood_pruned": "sofjax.likelihood",
    "image_log_likelihood": "sofjax.likelihood",
    # segments on the floor: eq. (9), Figs. 5 and 6
    "Observation": "sofjax.extraction",
    "Association": "sofjax.extraction",
    "MotionModel": "sofjax.motion",
    "SensorModel": "sofjax.likelihood",
    "LineNoise": "sofjax.likelihood",
    "MapConfig": "sofjax.segment_map",
    "FilterConfig": "sofjax.slam",
    "SlamConfig": "sofjax.slam",
    "SofSlam": "sofjax.slam",
    "pose_log_likelihood": "sofjax.slam",
    "PRESETS": "sofjax.slam",
}
_MODULES = (
    "geometry",
    "extraction",
    "motion",
    "likelihood",
    "particles",
    "segment_map",
    "slam",
    "smoothing",
    "loop_closure",
    "calibration",
    "evaluation",
    "io",
    "vision",
    "simulation",
    "viewer",
    "pipeline",
)

__all__ = [*_HOME, *_MODULES]


def __getattr__(name: str):
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    if name in _MODULES:
        return importlib.import_module(f"sofjax.{name}")
    raise AttributeError(f"module 'sofjax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
