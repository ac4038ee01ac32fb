"""Each choice of the method changed alone: what does it buy, on which floor?

    python experiments/ablation/run.py [--quick] [--seeds 20] [--only NAME ...] [--out DIR]

Random worlds and robots, the same number on each of five floors, seen as segments; every variant
runs on the same drives as the defaults, and the ratios of the errors are taken in pairs. Fewer
drives (--drawn) are drawn as images too, which takes longer and is the harder proof; Hough needs
them. What OUT/runs.json holds already is not run again. Writes ablation.json and ablation.png.
"""

import dataclasses
import json
import sys
import tempfile
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

sys.path.append(str(Path(__file__).parents[1]))
import common

from sofjax import SlamConfig
from sofjax.io.drive import read_drive
from sofjax.simulation import make_world, random_setup, record, simulate_run
from sofjax.vision import Frontend, FrontendSettings, observe_drive

FLOORS = ("blocks", "tiles", "diamonds", "planks", "stripes")
PARTICLES = 300
VARIANTS = {
    "sigma 5 cm, 2°, constant": {
        "sensor": {"propagate": False, "rho_sigma": 0.05, "theta_sigma": 0.035}
    },
    "sigma 2 cm, 1.1°, constant": {"sensor": {"propagate": False}},
    "pixel sigma halved": {"sensor": {"pixel_sigma": 0.25}},
    "pixel sigma doubled": {"sensor": {"pixel_sigma": 1.0}},
    "rigid mount": {"sensor": {"tilt_sigma": 0.0}},
    "noise of the sensor fixed": {"sensor": {"adaptation": 0.0}},
    "single winner": {"filter": {"choice": "winner"}},
    "gamma rule, eq. (14)": {"segment_map": {"rule": "gamma", "classify": False}},
    "Kalman, all lines on the floor": {"segment_map": {"classify": False}},
    "R = 2.5 m": {"segment_map": {"range": 2.5}},
    "R = 10 m": {"segment_map": {"range": 10.0}},
    "L = 2.5 m": {"segment_map": {"length": 2.5}},
    "L = 40 m": {"segment_map": {"length": 40.0}},
    "a line's two edges told apart": {"segment_map": {"directed": True}},
    "merge at 0 cm": {"segment_map": {"merge_distance": 0.0}},
    "merge at 5 cm": {"segment_map": {"merge_distance": 0.05}},
    "baseline: the image before": {
        "association": {"baseline_distance": 0.0, "baseline_angle": 0.0}
    },
    "baseline 0.5 m": {"association": {"baseline_distance": 0.5, "baseline_angle": 0.5}},
    "Theta = 3": {"association": {"gate": 3.0}},
    "Theta = 12": {"association": {"gate": 12.0}},
    "odometer not learned": {
        "motion": {"distance_scale_sigma": 0.0, "turn_scale_sigma": 0.0, "curvature_sigma": 0.0}
    },
    "no slips supposed": {"motion": {"slip_rate": 0.0}},
    "12 keyframes smoothed": {"window": {"keyframes": 12}},
    "lever arm ignored": {},
}
DEFAULT, LEVER, HOUGH = "defaults", "lever arm ignored", "Hough"
QUICK = ("gamma rule, eq. (14)", "Theta = 3", LEVER)


def config_of(variant: str) -> SlamConfig:
    config = common.config_of(filter={"particles": PARTICLES})
    for part, given in VARIANTS.get(variant, {}).items():
        config = dataclasses.replace(
            config, **{part: dataclasses.replace(getattr(config, part), **given)}
        )
    return config


def seeds_of(floor: str, first: int, count: int) -> list[int]:
    """The first seeds whose random world has that floor."""
    found, seed = [], first
    while len(found) < count:
        if common.floor_of(make_world("random", seed)) == floor:
            found.append(seed)
        seed += 1
    return found


def run_variant(variant: str, drives: list[common.Drive], keys: jax.Array) -> list[float]:
    """The errors of all drives."""
    camera, mount, log = common.stack(drives)
    if variant == LEVER:
        mount = eqx.tree_at(lambda m: (m.x, m.y), mount, (0 * mount.x, 0 * mount.y))
    T = common.run_batch(config_of(variant), camera, mount, log, keys).T_world_robot
    return [common.errors_of(d, common.one_of(T, i)).ate_m for i, d in enumerate(drives)]


def drawn_drives(seed: int, images: int) -> dict[str, common.Drive]:
    """One drive drawn, and what LSD and Hough find in its images."""
    world, setup = make_world("random", seed), random_setup(seed)
    simulated = simulate_run(world, setup, seed, max_images=images)
    odometry, found = simulated.odometry.at(simulated.truth.stamps), {}
    with tempfile.TemporaryDirectory() as folder:
        record(Path(folder) / "drive", world, setup, simulated, seed=seed)
        drive = read_drive(Path(folder) / "drive")
        camera, mount = drive.camera_file.camera, drive.camera_file.mount
        for detector in ("lsd", "hough"):
            settings = FrontendSettings(detector=detector, capacity=common.M)
            log = observe_drive(drive, Frontend(drive.camera_file, settings))
            log = jax.tree.map(np.asarray, log)
            found[detector] = common.Drive(camera, mount, log, simulated.truth, odometry)
    return found


def run_floor(
    floor: str, seeds: list[int], names: list[str], images: int, drawn: bool, done: dict
) -> None:
    """All variants on the drives of a floor, what `done` holds already left out."""
    label = [f"{floor} {seed}" for seed in seeds]
    missing = lambda name: bool(set(label) - set(done.get(name, {})))
    wanted = [name for name in names if missing(name)]
    if not wanted:
        return
    keys = jax.vmap(jax.random.key)(jnp.array(seeds, jnp.uint32))
    if drawn:
        both = [drawn_drives(seed, images) for seed in seeds]
        drives = [found["lsd"] for found in both]
    else:
        drives = [common.random_drive("random", seed, images) for seed in seeds]
    for name in wanted:
        seen = [found["hough"] for found in both] if name == HOUGH else drives
        errors = run_variant(name, seen, keys)
        done.setdefault(name, {}).update(zip(label, errors, strict=True))
        print(f"{floor} {name}: median {np.median(errors):.4f} m", flush=True)


def table_of(runs: dict) -> dict[str, dict]:
    """Ratios of the errors to those of the defaults: all drives, and each floor's."""
    table = {}
    for variant, errors in runs.items():
        pairs = {
            floor: np.array([(errors[name], runs[DEFAULT][name]) for name in errors
                             if name.startswith(floor) and name in runs[DEFAULT]])
            for floor in FLOORS
        }  # fmt: skip
        pairs = {floor: p for floor, p in pairs.items() if len(p)}
        every = np.concatenate(list(pairs.values()))
        table[variant] = row_of(every) | {"floors": {f: row_of(p) for f, p in pairs.items()}}
    return table


def row_of(pairs: np.ndarray) -> dict[str, object]:
    ratio, low, high = common.ratio_of(*pairs.T)
    median, worst = np.median(pairs[:, 0]), pairs[:, 0].max()
    return {"drives": len(pairs), "median_m": float(median), "worst_m": float(worst),
            "ratio": ratio, "interval": [low, high]}  # fmt: skip


def draw(tables: dict[str, dict], path: Path) -> None:
    names = [name for name in (*VARIANTS, HOUGH) if any(name in table for table in tables.values())]
    plot, every = common.pyplot().subplots(
        1, len(tables), figsize=(4 + 5 * len(tables), 1.2 + 0.28 * len(names)),
        layout="constrained", sharey=True, squeeze=False,
    )  # fmt: skip
    for axes, (source, table) in zip(every[0], tables.items(), strict=True):
        for i, name in enumerate(names):
            if name not in table:
                continue
            axes.plot(table[name]["interval"], [i, i], color="black", lw=2)
            axes.plot(table[name]["ratio"], i, "o", color="black", ms=5)
            for k, floor in enumerate(FLOORS):
                if floor in table[name]["floors"]:
                    label = floor if i == 0 else None
                    ratio = table[name]["floors"][floor]["ratio"]
                    axes.plot(ratio, i, "|", color=f"C{k}", ms=9, label=label)
        axes.axvline(1, color="grey", lw=0.8)
        axes.set_yticks(range(len(names)), names)
        axes.set(xscale="log", title=source, xlabel="error, times that of the defaults (95 %)")
        common.plain_ticks(axes.xaxis)
    every[0][0].invert_yaxis()
    every[0][0].legend(fontsize=8)
    plot.savefig(path, dpi=110)


def main() -> None:
    parser = common.options(__doc__, __file__)
    parser.add_argument("--seeds", type=int, default=20, help="of each floor, as segments")
    parser.add_argument("--drawn", type=int, default=4, help="of each floor, as images")
    parser.add_argument("--images", type=int, default=200, help="of each drive, at most")
    parser.add_argument("--only", metavar="NAME", nargs="+", choices=list(VARIANTS))
    args = parser.parse_args()
    images, floors, names = args.images, FLOORS, args.only or list(VARIANTS)
    counts = {"segments": args.seeds, "images": args.drawn}
    if args.quick:
        images, floors, names, counts = 40, FLOORS[:1], QUICK, {"segments": 2}
    args.out.mkdir(parents=True, exist_ok=True)
    kept = args.out / ("quick.json" if args.quick else "runs.json")
    done = json.loads(kept.read_text()) if kept.exists() else {}
    for source, count in counts.items():
        drawn, runs = source == "images", done.setdefault(source, {})
        for floor in floors if count else ():
            seeds = seeds_of(floor, args.seed, count)
            run_floor(floor, seeds, [DEFAULT, *names, *[HOUGH] * drawn], images, drawn, runs)
            kept.write_text(json.dumps(done, indent=1))
    tables = {source: table_of(runs) for source, runs in done.items() if runs}
    common.save(args.out, "ablation", args, {"particles": PARTICLES, "tables": tables})
    for source, table in tables.items():
        print(f"\n| {source} | drives | median, m | worst, m | times the defaults' (95 %) |")
        print("|" + "---|" * 5)
        for name, row in table.items():
            low, high = row["interval"]
            print(f"| {name} | {row['drives']} | {row['median_m']:.3f} | {row['worst_m']:.3f} | "
                  f"{row['ratio']:.2f} ({low:.2f} to {high:.2f}) |")  # fmt: skip
    draw(tables, args.out / "ablation.png")


if __name__ == "__main__":
    main()
