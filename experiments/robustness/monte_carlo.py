"""A hundred seeds of three worlds: how large is the error, and does the filter know it?

    python experiments/robustness/monte_carlo.py [--quick] [--seeds 100] [--images 250] [--out DIR]

Each seed has a robot of its own, in a world furnished by the seed, seen as segments; all runs
are at the default settings, in vmapped batches. Writes monte_carlo.json and .png, and keeps each
run in `drives/`, so that an interrupted study goes on where it was.
"""

import sys
from pathlib import Path

import jax
import numpy as np
from scipy.stats import chi2

sys.path.append(str(Path(__file__).parents[1]))
import common

from sofjax.evaluation import align
from sofjax.io.trajectory import Trajectory
from sofjax.simulation import make_world

WORLDS = ("paper", "l", "random")
BATCH = 10


def run_seeds(world: str, seeds: list[int], folder: Path, images: int) -> None:
    """Run what is not there yet."""
    missing = [seed for seed in seeds if not (folder / f"{world}-{seed}.npz").exists()]
    for first in range(0, len(missing), BATCH):
        batch = missing[first : first + BATCH]
        drives = {seed: common.random_drive(world, seed, images) for seed in batch}
        stacked = common.stack([drives[seed] for seed in batch])
        keys = jax.vmap(jax.random.key)(np.array(batch, np.uint32))
        infos = jax.device_get(common.run_batch(common.config_of(), *stacked, keys))
        for i, seed in enumerate(batch):
            path = common.path_of(drives[seed], common.one_of(infos.T_world_robot, i))
            result = judge(drives[seed], path, infos.covariance[i])
            np.savez(folder / f"{world}-{seed}.npz", **result, matched=infos.matched[i].mean())
            print(f"{world} {seed}: {result['ate']:.3f} m, odometry {result['odometry']:.3f} m, "
                  f"NEES {np.nanmedian(result['nees']):.1f}", flush=True)  # fmt: skip


def judge(drive: common.Drive, path: Trajectory, covariances: np.ndarray) -> dict[str, np.ndarray]:
    """Errors, and the normalised squared error of every pose in the frame of the first."""
    T = len(path.stamps)
    error = np.column_stack([path.xy, path.yaw]) - common.in_start(drive.truth)
    error[:, 2] = (error[:, 2] + np.pi) % (2 * np.pi) - np.pi
    P = covariances[:T].astype(float)
    some = np.linalg.det(P) > 0  # none before the robot has moved
    nees = np.full(T, np.nan)
    nees[some] = np.einsum(
        "ti,ti->t", error[some], np.linalg.solve(P[some], error[some][..., None])[..., 0]
    )
    errors, odometry = common.errors_of(drive, path), common.odometry_errors(drive)
    return {
        "ate": errors.ate_m, "percent": errors.ate_percent, "yaw": errors.yaw_deg,
        "odometry": odometry.ate_m, "odometry_percent": odometry.ate_percent,
        "odometry_yaw": odometry.yaw_deg, "path_m": errors.path_m, "nees": nees, "error": error,
        "sigma": np.sqrt(np.diagonal(P, axis1=1, axis2=2)), "xy": path.xy, "true": drive.truth.xy,
        "odometry_xy": drive.odometry.xy,
    }  # fmt: skip


def at_shares(values: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """A drive's values at shares of its length."""
    return values[(shares * (len(values) - 1)).astype(int)]


SHARES = np.linspace(0.05, 1, 39)


def summary(runs: list[dict]) -> dict:
    """Quantiles of the errors, and the mean NEES with the band of as many runs."""
    n = len(runs)
    quantiles = lambda name: np.percentile([r[name] for r in runs], [50, 75, 90, 95, 100]).round(4)
    nees = np.array([at_shares(r["nees"], SHARES) for r in runs])
    band = chi2.ppf([0.025, 0.975], 3 * n) / n
    mean = np.nanmean(nees, axis=0)
    inside = chi2.cdf(nees, 3)
    ratio = np.concatenate([np.abs(r["error"][20:] / r["sigma"][20:]) for r in runs])
    apart = np.array([r["error"][-1] for r in runs])
    return {
        "runs": n,
        "worse_than_odometry": int(sum(r["ate"] > r["odometry"] for r in runs)),
        "quantiles": [50, 75, 90, 95, 100],
        "ate_m": quantiles("ate"), "ate_percent": quantiles("percent"), "yaw_deg": quantiles("yaw"),
        "odometry_m": quantiles("odometry"), "odometry_percent": quantiles("odometry_percent"),
        "nees_mean": float(np.nanmean(nees)), "nees_median": float(np.nanmedian(nees)),
        "nees_mean_at_shares": mean.round(2), "nees_band_of_the_mean": band,
        "shares_inside_band": float(((mean > band[0]) & (mean < band[1])).mean()),
        "poses_inside_their_95_percent": float((inside < 0.95).mean()),
        "error_over_sigma_median": np.median(ratio, axis=0).round(2),  # x, y, yaw
        "error_at_the_end_rms": np.sqrt(np.mean(apart**2, axis=0)).round(4),
        "sigma_at_the_end_rms": np.sqrt(np.mean([r["sigma"][-1] ** 2 for r in runs], 0)).round(4),
        "worst_seed": int(max(runs, key=lambda r: r["percent"])["seed"]),
    }  # fmt: skip


def draw(out: Path, runs: dict[str, list[dict]], summaries: dict) -> None:
    plt = common.pyplot()
    from matplotlib.collections import LineCollection

    world = max(runs, key=lambda name: max(r["percent"] for r in runs[name]))
    worst = max(runs[world], key=lambda r: r["percent"])
    seed = int(worst["seed"])
    plot, ((left, middle), (where, when)) = plt.subplots(
        2, 2, figsize=(12, 9.5), layout="constrained"
    )
    for i, (name, mine) in enumerate(runs.items()):
        n = len(mine)
        for key, style in (("percent", "-"), ("odometry_percent", ":")):
            left.step(sorted(r[key] for r in mine), np.arange(1, n + 1) / n, style, color=f"C{i}",
                      where="post", label=f"{name}{', odometry' * (style == ':')}")  # fmt: skip
        middle.plot(100 * SHARES, summaries[name]["nees_mean_at_shares"], color=f"C{i}", label=name)
    band = next(iter(summaries.values()))["nees_band_of_the_mean"]
    middle.axhspan(*band, color="grey", alpha=0.4, label=f"95 % band of {n} runs")
    left.set(xscale="log", xlabel="ATE, % of the path", ylabel="share of the runs")
    middle.set(yscale="log", xlabel="% of the drive", ylabel="mean NEES of (x, y, yaw)")
    segments = make_world(world, seed).floor_segments.endpoints[:, :, :2]
    where.add_collection(LineCollection(segments, colors="#cfd5da", lw=0.6))
    where.plot(*worst["true"].T, color="black", lw=1, label="true")
    for key, colour, label in (
        ("xy", "#c0392b", "estimate"),
        ("odometry_xy", "#e08e0b", "odometry"),
    ):
        moved = align(worst[key], worst["true"]).apply(worst[key])
        where.plot(*moved.T, color=colour, lw=1, ls="--" if key != "xy" else "-", label=label)
    where.set(title=f"the worst: {world}, seed {seed}, {worst['ate']:.2f} m "
              f"({worst['percent']:.2f} %)", xlabel="m", ylabel="m", aspect="equal")  # fmt: skip
    seconds = 0.1 * np.arange(len(worst["error"]))
    for i, (name, unit) in enumerate((("x", 1), ("y", 1), ("yaw, 10°", np.radians(10)))):
        when.plot(seconds, worst["error"][:, i] / unit, color=f"C{i}", label=name)
        band = 2 * worst["sigma"][:, i] / unit
        when.fill_between(seconds, -band, band, color=f"C{i}", alpha=0.2)
    when.set(xlabel="s", ylabel="error, m (yaw in 10°); shaded: ± 2 sigma of the particles",
             title="its errors in the frame of the start")  # fmt: skip
    for axes in (left, middle, where, when):
        axes.legend(fontsize=8)
    plot.savefig(out / "monte_carlo.png", dpi=110)


def main() -> None:
    parser = common.options(__doc__, __file__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--images", type=int, default=250, help="of each drive, at most")
    args = parser.parse_args()
    seeds, images = (3, 60) if args.quick else (args.seeds, args.images)
    worlds = WORLDS[1:2] if args.quick else WORLDS
    folder = args.out / ("drives-quick" if args.quick else "drives")
    folder.mkdir(parents=True, exist_ok=True)
    seeds = list(range(args.seed, args.seed + seeds))
    runs, summaries = {}, {}
    for world in worlds:
        run_seeds(world, seeds, folder, images)
        runs[world] = [
            dict(np.load(folder / f"{world}-{seed}.npz")) | {"seed": seed} for seed in seeds
        ]
        summaries[world] = summary(runs[world])
    common.save(args.out, "monte_carlo", args, {"worlds": summaries})
    for name, s in summaries.items():
        print(f"{name}: ATE 50/75/90/95/100 % {s['ate_percent']} % of the path, odometry "
              f"{s['odometry_percent']}; mean NEES {s['nees_mean']:.1f} (band "
              f"{s['nees_band_of_the_mean'].round(2)}), inside 95 %: "
              f"{s['poses_inside_their_95_percent']:.2f}; worst {s['worst_seed']}")  # fmt: skip
    draw(args.out, runs, summaries)


if __name__ == "__main__":
    main()
