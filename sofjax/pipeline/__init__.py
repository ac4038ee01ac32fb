"""A drive in, its result out: what the command line prints, as a library.

The names below are loaded when they are first used: the argument parser imports this package too.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sofjax.pipeline.calibrate import Calibration as Calibration
    from sofjax.pipeline.calibrate import calibrate_drive as calibrate_drive
    from sofjax.pipeline.drive import run_drive as run_drive
    from sofjax.pipeline.evaluate import RunEvaluation as RunEvaluation
    from sofjax.pipeline.evaluate import evaluate_run as evaluate_run
    from sofjax.pipeline.inspect import Inspection as Inspection
    from sofjax.pipeline.inspect import inspect_drive as inspect_drive
    from sofjax.pipeline.results import DriveResult as DriveResult
    from sofjax.pipeline.results_files import RunWriter as RunWriter
    from sofjax.pipeline.results_files import open_run as open_run
    from sofjax.pipeline.settings import RunSettings as RunSettings

_HOME = {
    "RunSettings": "settings",
    "run_drive": "drive",
    "DriveResult": "results",
    "open_run": "results_files",
    "RunWriter": "results_files",
    "calibrate_drive": "calibrate",
    "Calibration": "calibrate",
    "evaluate_run": "evaluate",
    "RunEvaluation": "evaluate",
    "inspect_drive": "inspect",
    "Inspection": "inspect",
}


def __getattr__(name: str) -> object:
    if name in _HOME:
        return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return list(_HOME)
