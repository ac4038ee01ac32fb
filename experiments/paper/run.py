"""Section IV of the paper again: a loop of corridors before and after closing, by some settings.

    python experiments/paper/run.py --out runs/paper                    # a simulated loop, seed 0
    python experiments/paper/run.py --out runs/paper --drive DRIVE      # a recorded one
    python experiments/paper/run.py --out runs/paper --quick            # a short corridor

Writes `paper.png` (Figs. 8 and 9 by the settings of the paper and by the defaults), `paper.json`
and the folder of every run; a run that is there already is not repeated.
"""

import json
import sys
from pathlib import Path

from matplotlib.collections import LineCollection

sys.path.append(str(Path(__file__).parents[1]))
import common

from sofjax.cli import main as sofjax
from sofjax.evaluation import align
from sofjax.io.drive import read_drive
from sofjax.io.map_file import read_map
from sofjax.io.trajectory import read_trajectory

PAPER = ["--loop", "none", "--set", "preset=paper"]
RUNS = {
    "paper": ("the paper's settings", PAPER),
    "paper-closed": ("and its closing", ["--loop", "paper", "--set", "preset=paper"]),
    "lsd": ("LSD for Hough", [*PAPER, "frontend.detector=lsd"]),
    "resample": ("resampling for the winner", [*PAPER, "filter.choice=resample"]),
    "covariance": ("each segment's own covariance", [*PAPER, "sensor.propagate=true"]),
    "odometer": (
        "the odometer's errors learned",
        [
            *PAPER,
            "motion.distance_scale_sigma=0.01",
            "motion.turn_scale_sigma=0.05",
            "motion.curvature_sigma=0.005",
        ],
    ),
    "defaults": ("sofjax's defaults", ["--loop", "none"]),
    "defaults-smooth": ("smoothed", []),
}
FIGURE = ("paper", "paper-closed", "defaults", "defaults-smooth")


def report_of(drive: Path, folder: Path, options: list[str]) -> dict:
    """Run, unless that has been done."""
    path = folder / "report.json"
    done = path.exists() and json.loads(path.read_text())["loop"].get("status") != "not finished"
    if not done:
        code = sofjax(["run", str(drive), "--out", str(folder), *options])
        if code:
            raise SystemExit(code)
    return json.loads(path.read_text())


def figures_of(report: dict) -> dict:
    errors = report["errors"]
    path = errors.get("smoothed") or errors["trajectory"]
    names = ("path_m", "ate_m", "ate_percent", "yaw_deg", "end_gap_m")
    return {name: path[name] for name in names} | {
        "segments": report["funnel"]["mapped"],
        "precision": (errors["map"] or {}).get("precision"),
        "recall": (errors["map"] or {}).get("recall"),
        "loops": (report.get("loop") or {}).get("accepted", 0),
    }


def draw(drive_folder: Path, out: Path, figures: dict) -> None:
    drive = read_drive(drive_folder)
    plot, all_axes = common.pyplot().subplots(2, 2, figsize=(12, 12), sharex=True, sharey=True)
    for name, axes in zip(FIGURE, all_axes.flat, strict=True):
        folder, f = out / name, figures[name]
        smoothed = folder / "trajectory_smoothed.txt"
        path = read_trajectory(smoothed if smoothed.exists() else folder / "trajectory.txt")
        segments, _ = read_map(folder / "map.geojson")
        motion = align(path.xy, drive.groundtruth.at(path.stamps).xy)
        onto = align(drive.odometry.xy[:50], drive.groundtruth.at(drive.odometry.stamps[:50]).xy)
        if drive.floor_segments is not None:
            axes.add_collection(LineCollection(drive.floor_segments, colors="#cfd5da", lw=2.5))
        axes.add_collection(LineCollection(motion.apply(segments), colors="#1f4e9c", lw=0.9))
        axes.plot(*onto.apply(drive.odometry.xy).T, color="#e08e0b", ls="--", lw=1)
        axes.plot(*motion.apply(path.xy).T, color="#c0392b", lw=1.2)
        axes.set_title(
            f"{'Fig. 9' if name in FIGURE[1::2] else 'Fig. 8'}: {RUNS[name][0]}\n"
            f"{f['ate_m']:.3f} m, {f['yaw_deg']:.2f}°, {f['segments']} segments", fontsize=10
        )  # fmt: skip
        axes.set_aspect("equal")
    plot.supxlabel("metres; grey: true floor, blue: map, red: path, dashed: odometry", fontsize=9)
    plot.tight_layout()
    plot.savefig(out / "paper.png", dpi=110)


def main() -> None:
    parser = common.options(__doc__, __file__)
    parser.add_argument("--drive", type=Path, help="instead of a simulated one")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    drive = options.drive or options.out / "drive"
    if not (drive / "rgb.txt").exists():
        world = ["--world", "l", "--images", "60"] if options.quick else ["--world", "paper"]
        if sofjax(["simulate", *world, "--seed", str(options.seed), "--out", str(drive)]):
            raise SystemExit(2)
    figures = {}
    for name, (_, settings) in RUNS.items():
        if name in FIGURE or not options.quick:
            settings = ["--seed", str(options.seed), *settings]
            report = report_of(drive, options.out / name, settings)
            figures[name] = figures_of(report)
    odometry = report["errors"]["odometry"]
    print(f"\n{'':32s}   ATE m   yaw °   end m  segments  precision  recall  loops")
    print(f"{'odometry':32s} {odometry['ate_m']:7.3f} {odometry['yaw_deg']:7.2f} "
          f"{odometry['end_gap_m']:7.2f}")  # fmt: skip
    for name, f in figures.items():
        print(
            f"{RUNS[name][0]:32s} {f['ate_m']:7.3f} {f['yaw_deg']:7.2f} {f['end_gap_m']:7.2f} "
            f"{f['segments']:9d} {f['precision'] or 0:10.2f} {f['recall'] or 0:7.2f} "
            f"{f['loops']:6d}"
        )
    result = {"drive": drive, "odometry": odometry, "runs": figures}
    common.save(options.out, "paper", options, result)
    draw(drive, options.out, figures)


if __name__ == "__main__":
    main()
