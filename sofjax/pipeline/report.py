"""`report.json`: all that there is to know about a run, for machines and for later."""

import platform
import resource
import sys
from dataclasses import asdict
from importlib.metadata import version

import jax

from sofjax.io.settings import to_dict
from sofjax.pipeline import run_folder
from sofjax.pipeline.results import DriveResult

FUNNEL = {  # units, and what each count of it means
    "images": "images: those that the filter took",
    "segments": "segments: found in the images, after undistortion and of the least length",
    "below_horizon": "segments: of these, on the floor's side of the horizon and within range",
    "associated": "segments: of these, moving as the floor does between two images, by eq. (9)",
    "matched": "segments: of these, showing a line that the map knew",
    "born": "lines: begun in the map",
    "mapped": "lines: in the final map, on the floor",
}
PACKAGES = ("sofjax", "jax", "jaxlib", "equinox", "numpy", "opencv-python-headless")


def report_of(
    result: DriveResult,
    seconds: dict[str, float],
    calibration: dict[str, object] | None,
    digest: str,
) -> dict[str, object]:
    """The report of a run.

    **Arguments:**
    - `seconds`: that each stage took.
    - `calibration`: what `--calibrate` found, if it was asked for.
    - `digest`: of the map's file. If the file has another, the run was killed on the way to its
      report.
    """
    run_log = result.log
    first = {"first_image": sum(run_log.seconds[0].values())} if run_log.seconds else {}
    return {
        "drive": str(result.drive.path.resolve()),
        "interrupted": result.stopped,
        "seed": result.settings.seed,
        "settings": to_dict(result.settings),
        "calibration": calibration,
        **_machine(),
        "funnel": _funnel(result),
        "left_out": result.map.left_out,
        "map": {
            "of": run_folder.SMOOTHED if result.closed else run_folder.TRAJECTORY,
            "sha256": digest,
        },
        "overflow": {"segments": run_log.overflow, "map": run_log.step["map_overflow"]},
        "images": {
            "listed": len(result.drive.image_files),
            "done": len(run_log.stamps),
            "without_segments": run_log.without_segments,
            "lost": run_log.step["lost"],
            "unreadable": run_log.unreadable,
        },
        "noise": run_log.noise | {"images_given_up": result.given_up},
        "longest_without_lines_across_m": run_log.longest_without_across,
        "loop": result.loop,
        "frames_per_second": run_log.frames_per_second,
        "milliseconds_per_image": run_log.milliseconds(),
        "seconds": seconds | first,
        "peak_memory_mib": peak_memory(),
        "errors": _errors(result),
        "warnings": result.warnings,
    }


def peak_memory() -> float:
    """MiB that the process has held at most."""
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def _machine() -> dict[str, object]:
    return {
        "versions": {"python": platform.python_version()}
        | {package: version(package) for package in PACKAGES},
        "device": f"{jax.default_backend()}, {platform.machine()}",
    }


def _funnel(result: DriveResult) -> dict[str, object]:
    run_log = result.log
    return {
        "images": len(run_log.stamps),
        "segments": run_log.detected,
        "below_horizon": run_log.step["below_horizon"],
        "associated": run_log.step["associated"],
        "matched": run_log.step["reobserved"],
        "born": run_log.step["initialised"],
        "mapped": len(result.segments),
        "meaning": FUNNEL,
    }


def _errors(result: DriveResult) -> dict[str, object]:
    errors = result.errors
    return {
        name: asdict(each) if each else None
        for name, each in (
            ("trajectory", errors.trajectory),
            ("smoothed", errors.smoothed),
            ("odometry", errors.odometry),
            ("map", errors.map),
        )
    }
