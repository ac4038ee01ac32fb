"""A hundred random worlds, each driven once and run at the default settings of `sofjax run`.

    python experiments/robustness/random_worlds.py [--quick] [--worlds N] [--set name=value ...]

World, robot, camera and odometer are those of `sofjax simulate --world random --seed S`. Worlds
that OUT/results.csv holds already are skipped, so an interrupted run goes on where it was; the
drives themselves are not kept. Ends with the distribution of the error.
"""

import contextlib
import csv
import io
import json
import math
import sys
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1]))
import common

from sofjax.cli import main as sofjax
from sofjax.simulation import make_world

COLUMNS = (
    "seed", "floor", "images", "path_m", "ate_m", "ate_percent", "yaw_deg", "drift_percent",
    "odometry_percent", "map_precision", "map_recall", "matched", "without_segments", "lost",
    "height_m", "pitch_deg", "focal_px", "seconds", "failure",
)  # fmt: skip


def one(seed: int, folder: Path, few: list[str], settings: list[str]) -> dict[str, object]:
    """Simulate and run one world; `failure` says what went wrong, if anything did."""
    begun = time.perf_counter()
    drive, out = folder / f"world-{seed}", folder / f"run-{seed}"
    row: dict[str, object] = {
        "seed": seed,
        "floor": common.floor_of(make_world("random", seed)),
        "failure": "",
    }
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            world = ["--world", "random", "--seed", str(seed), *few]
            codes = [sofjax(["simulate", *world, "--out", str(drive)])]
            codes += [sofjax(["run", str(drive), "--out", str(out), *settings])]
        if any(codes):
            row["failure"] = f"exit codes {codes}: {said.getvalue()[-300:]!r}"
    except Exception:
        row["failure"] = traceback.format_exc().splitlines()[-1]
    if not row["failure"]:
        report = json.loads((out / "report.json").read_text())
        errors, funnel = report["errors"], report["funnel"]
        row |= {name: errors["trajectory"][name] for name in ("path_m", "ate_m", "ate_percent")}
        row |= {name: errors["trajectory"][name] for name in ("yaw_deg", "drift_percent")}
        row |= {
            "images": funnel["images"],
            "odometry_percent": errors["odometry"]["ate_percent"],
            "map_precision": errors["map"]["precision"],
            "map_recall": errors["map"]["recall"],
            "matched": funnel["matched"] / funnel["images"],
            "without_segments": report["images"]["without_segments"],
            "lost": report["images"]["lost"],
        }
        row |= camera_of(drive)
        poses = np.loadtxt(out / "trajectory.txt")
        if not np.isfinite(poses).all() or row["ate_percent"] is None:
            row["failure"] = "not finite"
    row["seconds"] = time.perf_counter() - begun
    return row


def camera_of(drive: Path) -> dict[str, float]:
    from sofjax.io.camera_file import read_camera

    file = read_camera(drive / "camera.yaml")
    return {
        "height_m": float(file.mount.height),
        "pitch_deg": math.degrees(file.mount.pitch),
        "focal_px": float(file.camera.K[0, 0]),
    }


def summary(results: Path) -> str:
    """The distribution, and the worlds over 1 %."""
    rows = list(csv.DictReader(results.open()))
    failed = [row for row in rows if row["failure"]]
    done = [row for row in rows if not row["failure"]]
    ate = np.array([float(row["ate_percent"]) for row in done])
    wheel = np.array([float(row["odometry_percent"]) for row in done])
    quantiles = (50, 75, 90, 95, 100)
    lines = [
        f"{len(rows)} worlds: {len(failed)} failed, {(ate <= 1).sum()} at 1 % or less",
        "| % of the path | " + " | ".join(f"{q} %" for q in quantiles) + " |",
        "|---|" + "---|" * len(quantiles),
        "| sofjax | " + " | ".join(f"{np.percentile(ate, q):.2f}" for q in quantiles) + " |",
        "| odometry | " + " | ".join(f"{np.percentile(wheel, q):.2f}" for q in quantiles) + " |",
    ]
    for floor in sorted({row["floor"] for row in done}):
        mine = ate[[row["floor"] == floor for row in done]]
        lines.append(
            f"{floor}: {len(mine)} worlds, median {np.median(mine):.2f} %, worst {mine.max():.2f} %"
        )
    for row in failed:
        lines.append(f"seed {row['seed']} failed: {row['failure']}")
    for row in sorted(done, key=lambda row: -float(row["ate_percent"])):
        if float(row["ate_percent"]) > 1:
            lines.append(
                f"seed {row['seed']}: {float(row['ate_percent']):.2f} %, odometry "
                f"{float(row['odometry_percent']):.2f} %, {row['floor']}, matched "
                f"{float(row['matched']):.1f} an image, camera {float(row['height_m']):.2f} m"
            )
    return "\n".join(lines)


def draw(rows: list[dict[str, str]], path: Path) -> None:
    plot, axes = common.pyplot().subplots(figsize=(6.5, 4), layout="constrained")
    floors = sorted({row["floor"] for row in rows})
    for floor in floors:
        mine = [row for row in rows if row["floor"] == floor]
        x, y = ([float(row[k]) for row in mine] for k in ("odometry_percent", "ate_percent"))
        axes.plot(x, y, "o", ms=4, label=floor)
    reach = [0.9 * min(float(row["ate_percent"]) for row in rows), 4]
    axes.plot(reach, reach, color="grey", lw=0.8)
    axes.set(xscale="log", yscale="log", xlabel="odometry, % of the path",
             ylabel="while driving, % of the path", title=f"{len(rows)} random worlds")  # fmt: skip
    axes.legend(fontsize=8)
    plot.savefig(path, dpi=110)


def main() -> None:
    parser = common.options(__doc__, __file__)
    parser.add_argument("--worlds", type=int, default=100)
    parser.add_argument(
        "--set", metavar="name=value", nargs="+", default=[], help="of `sofjax run`"
    )
    args = parser.parse_args()
    settings = ["--set", *args.set] if args.set else []
    worlds, few = (1, ["--images", "60"]) if args.quick else (args.worlds, [])
    results, known = args.out / ("quick.csv" if args.quick else "results.csv"), set()
    args.out.mkdir(parents=True, exist_ok=True)
    if results.exists():
        known = {int(row["seed"]) for row in csv.DictReader(results.open())}
    for seed in range(args.seed, args.seed + worlds):
        if seed in known:
            continue
        with tempfile.TemporaryDirectory() as folder:
            row = one(seed, Path(folder), few, settings)
        with results.open("a", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, restval="")
            if file.tell() == 0:
                writer.writeheader()
            row = {name: f"{v:.5g}" if isinstance(v, float) else v for name, v in row.items()}
            writer.writerow(row)
        told = (seed, row["floor"], row.get("ate_percent"), row["failure"])
        print(*told, f"{row['seconds']} s", flush=True)
    print(summary(results))
    rows = list(csv.DictReader(results.open()))
    common.save(args.out, "random_worlds", args, {"worlds": rows})
    done = [row for row in rows if not row["failure"]]
    if done:
        draw(done, args.out / "random_worlds.png")
    if len(done) < len(rows):
        sys.exit(f"{len(rows) - len(done)} of {len(rows)} failed")


if __name__ == "__main__":
    main()
