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
    "homographies": "sofjax.batch",
    "transferred_lines": "sofjax.batch",
    "association_scores": "sofjax.batch",
    "log_likelihood": "sofjax.batch",
    "log_likelihood_pruned": "sofjax.batch",
    "image_log_likelihood": "sofjax.batch",
    # segments on the floor: eq. (9), Figs. 5 and 6
    "Observation": "sofjax.observation",
    "Association": "sofjax.association",
    "MotionModel": "sofjax.motion",
    "SensorModel": "sofjax.sightings",
    "MapRules": "sofjax.segment_map",
    "FilterRules": "sofjax.slam",
    "SlamConfig": "sofjax.slam",
    "PRESETS": "sofjax.presets",
}
_MODULES = ("geometry", "association", "sof", "motion", "sightings", "likelihood", "particles")
_MODULES += (
    "segment_map",
    "slam",
    "presets",
    "batch",
    "smoothing",
    "loop_closure",
    "calibration",
    "observation",
    "evaluation",
    "io",
    "vision",
    "simulation",
    "viewer",
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
