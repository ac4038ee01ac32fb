"""What is smoothing the last keyframes while driving worth, over whole drives?

    python experiments/ablation/fixed_lag.py [--quick] [--drives 60] [--seed S] [--out DIR]

Random worlds and robots seen as segments, driven whole by the filter alone and with windows of
several sizes, with the same seed; the ratios of the errors are taken in pairs. What OUT/runs.json
holds already is not run again. Writes fixed_lag.json and fixed_lag.png.
"""

import json
import sys
import time
from pathlib import Path

import jax
import numpy as np

sys.path.append(str(Path(__file__).parents[1]))
import common

from sofjax import SofSlam

SIZES = (0, 8, 12)  # keyframes; 0: none are smoothed


def run_drive(seed: int, sizes: tuple[int, ...], images: int | None) -> dict[str, dict]:
    """By size: error while driving, metres and degrees, and the processor's milliseconds a step."""
    drive, found = common.random_drive("random", seed, images), {}
    T = len(drive.truth.stamps)
    room = lambda a: np.concatenate([a, np.zeros((-T % 800, *a.shape[1:]), a.dtype)])
    log = jax.tree.map(room, drive.observations)  # few lengths to compile for
    for size in sizes:
        config = common.config_of(window={"keyframes": size})
        slam = SofSlam(config, drive.camera, drive.mount)
        state = slam.init(jax.random.key(seed), common.M)
        call = lambda slam=slam, state=state: jax.block_until_ready(slam.run(state, log))
        begun, before = time.process_time(), SofSlam.run._cache_size()
        _, info = call()
        if SofSlam.run._cache_size() > before:  # it was compiled
            begun = time.process_time()
            _, info = call()
        ms = 1e3 * (time.process_time() - begun) / len(log.motion.yaw)
        errors = common.errors_of(drive, info.T_world_robot)
        found[str(size)] = {"ate_m": errors.ate_m, "yaw_deg": errors.yaw_deg, "cpu_ms": ms,
                            "path_m": errors.path_m}  # fmt: skip
    return found


def table_of(runs: dict[str, dict]) -> dict[str, dict]:
    table = {}
    for size in next(iter(runs.values())):
        of = lambda size, key: np.array([drive[size][key] for drive in runs.values()])
        row = {"drives": len(runs), "cpu_ms": float(np.median(of(size, "cpu_ms")))}
        for key in ("ate_m", "yaw_deg"):
            ratio, low, high = common.ratio_of(of(size, key), of("0", key))
            quantiles = np.percentile(of(size, key), [50, 90, 100])
            row[key] = {"quantiles": quantiles, "ratio": ratio, "interval": [low, high]}
        table[size] = row
    return table


def draw(runs: dict[str, dict], path: Path) -> None:
    plot, axes = common.pyplot().subplots(figsize=(5, 4.5), layout="constrained")
    for k, size in enumerate(s for s in next(iter(runs.values())) if s != "0"):
        pairs = np.array([[d["0"]["ate_m"], d[size]["ate_m"]] for d in runs.values()]) * 1000
        axes.plot(*pairs.T, "ox"[k % 2], ms=4, mfc="none", label=f"{size} keyframes")
    ends = [d["0"]["ate_m"] * 1000 for d in runs.values()]
    axes.plot([min(ends), max(ends)], [min(ends), max(ends)], color="grey", lw=0.8)
    axes.set(xscale="log", yscale="log", xlabel="filter alone, mm", ylabel="with a window, mm")
    common.plain_ticks(axes.xaxis)
    common.plain_ticks(axes.yaxis)
    axes.legend()
    plot.savefig(path, dpi=110)


def main() -> None:
    parser = common.options(__doc__, __file__)
    parser.add_argument("--drives", type=int, default=60)
    args = parser.parse_args()
    drives, sizes, images = (2, (0, 8), 60) if args.quick else (args.drives, SIZES, None)
    args.out.mkdir(parents=True, exist_ok=True)
    kept = args.out / ("quick-runs.json" if args.quick else "runs.json")
    runs = json.loads(kept.read_text()) if kept.exists() else {}
    for seed in range(args.seed, args.seed + drives):
        if str(seed) not in runs:
            runs[str(seed)] = run_drive(seed, sizes, images)
            kept.write_text(json.dumps(runs, indent=1))
            told = ", ".join(f"{k}: {v['ate_m']:.4f} m" for k, v in runs[str(seed)].items())
            print(f"drive {seed}: {told}", flush=True)
    table = table_of(runs)
    common.save(args.out, "fixed_lag", args, {"table": table})
    print("\n| keyframes | ATE m: 50, 90, 100 % | ratio (95 %) | yaw ° | ratio (95 %) | CPU ms |")
    print("|" + "---|" * 6)
    for size, row in table.items():
        parts = []
        for key in ("ate_m", "yaw_deg"):
            parts.append(", ".join(f"{q:.3f}" for q in row[key]["quantiles"]))
            parts.append("{:.2f} ({:.2f} to {:.2f})".format(
                row[key]["ratio"], *row[key]["interval"]))  # fmt: skip
        print(f"| {size} | {' | '.join(parts)} | {row['cpu_ms']:.2f} |")
    draw(runs, args.out / "fixed_lag.png")


if __name__ == "__main__":
    main()
