"""Error and frames a second from 10 to 100,000 particles: where do more stop helping?

    python experiments/particles/run.py [--quick] [--seeds 4] [--out DIR]

Stretches of three worlds seen as segments, the same at every size, so that errors are compared in
pairs. The largest sizes have one seed of each world. Writes particles.json and particles.png.
"""

import sys
import time
from pathlib import Path

import jax
import numpy as np

sys.path.append(str(Path(__file__).parents[1]))
import common

from sofjax import SofSlam

WORLDS = ("paper", "l", "random")
SIZES = (10, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000)
MANY = 10_000  # from here on one seed of each world
USUAL = 1000


def run_size(N: int, drives: dict[str, common.Drive]) -> dict[str, object]:
    """The error of every drive, and the milliseconds of a step once compiled."""
    config = common.config_of(filter={"particles": N})
    errors, cpu, wall, images = {}, 0.0, 0.0, 0
    for name, drive in drives.items():
        camera, mount, log = common.one_of(common.stack([drive]), 0)
        slam = SofSlam(config, camera, mount)
        start = slam.init(jax.random.key(7), common.M)
        call = lambda slam=slam, s=start, log=log: jax.block_until_ready(slam.run(s, log))
        if not errors:
            call()  # compiles
        c, w = time.process_time(), time.perf_counter()
        _, info = call()
        cpu, wall = cpu + time.process_time() - c, wall + time.perf_counter() - w
        images += log.motion.yaw.shape[0]
        errors[name] = common.errors_of(drive, info.T_world_robot).ate_m
    return {
        "ate_m": errors, "cpu_ms": 1e3 * cpu / images, "wall_ms": 1e3 * wall / images,
        "frames_per_second": images / wall,
    }  # fmt: skip


def compare(table: dict[int, dict]) -> None:
    """Each size against the usual one, on the drives of both: ratio of the errors, 95 %."""
    usual = table[min(table, key=lambda N: abs(N - USUAL))]["ate_m"]
    for row in table.values():
        pairs = [(ate, usual[name]) for name, ate in row["ate_m"].items()]
        row["ratio"], *row["interval"] = common.ratio_of(*np.array(pairs).T)
        row["median_m"] = float(np.median(list(row["ate_m"].values())))


def draw(table: dict[int, dict], path: Path) -> None:
    plot, (left, right) = common.pyplot().subplots(1, 2, figsize=(11, 4), layout="constrained")
    sizes = list(table)
    for name in table[sizes[0]]["ate_m"]:
        known = [N for N in sizes if name in table[N]["ate_m"]]
        left.plot(known, [100 * table[N]["ate_m"][name] for N in known], color="#9aa5b1", lw=0.8)
    of_all = [N for N in sizes if len(table[N]["ate_m"]) == len(table[sizes[0]]["ate_m"])]
    middle = [100 * table[N]["median_m"] for N in of_all]
    left.plot(of_all, middle, "o-", color="#c0392b", label="median")
    left.set(xscale="log", yscale="log", xlabel="particles", ylabel="ATE, cm; grey: each drive")
    common.plain_ticks(left.yaxis)
    left.legend()
    for key, label in (("cpu_ms", "CPU"), ("wall_ms", "wall")):
        right.plot(sizes, [table[N][key] for N in sizes], "o-", label=label)
    right.axhline(100, color="grey", ls=":", label="10 frames a second")
    right.set(xscale="log", yscale="log", xlabel="particles", ylabel="ms a step")
    right.legend()
    plot.savefig(path, dpi=110)


def main() -> None:
    parser = common.options(__doc__, __file__)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--images", type=int, default=150, help="of each drive")
    args = parser.parse_args()
    worlds, seeds, images, sizes = WORLDS, args.seeds, args.images, SIZES
    if args.quick:
        worlds, seeds, images, sizes = ("l",), 2, 50, (10, 1000)
    drives = {
        f"{world} {seed}": common.random_drive(world, seed, images)
        for seed in range(args.seed, args.seed + seeds)
        for world in worlds
    }
    table = {}
    for N in sizes:
        few = len(drives) if N <= MANY else len(worlds)
        table[N] = run_size(N, dict(list(drives.items())[:few]))
        row = table[N]
        median = np.median(list(row["ate_m"].values()))
        print(f"{N:7d}: median {median:.4f} m of {few}, {row['cpu_ms']:.1f} ms CPU, "
              f"{row['frames_per_second']:.0f} frames/s", flush=True)  # fmt: skip
    compare(table)
    odometry = {name: common.odometry_errors(drive).ate_m for name, drive in drives.items()}
    common.save(args.out, "particles", args, {"odometry_ate_m": odometry, "sizes": table})
    for N, row in table.items():
        low, high = row["interval"]
        print(f"{N:7d}: error {row['ratio']:.2f} ({low:.2f} to {high:.2f}) times that of {USUAL}")
    draw(table, args.out / "particles.png")


if __name__ == "__main__":
    main()
