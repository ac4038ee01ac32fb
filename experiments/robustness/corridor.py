"""Thirty metres straight on, with lines across the way and without: what holds the distance?

    python experiments/robustness/corridor.py [--quick] [--seeds 20] [--out DIR]

One corridor, border stripes and baseboards along it; across the way bars as wide as the paper's
blocks, or joints of 2 cm, every two to three metres, or nothing. Each seed has a robot of its own,
seen as segments. The first seed is drawn in images too, and `sofjax run` is asked what it says.
Writes corridor.json and corridor.png.
"""

import dataclasses
import json
import shutil
import sys
from pathlib import Path

import jax
import numpy as np

sys.path.append(str(Path(__file__).parents[1]))
import common

from sofjax.cli import main as sofjax
from sofjax.simulation import (
    Areas,
    FloorLines,
    World,
    make_world,
    random_setup,
    record,
    rectangle,
    simulate_run,
)

KINDS = ("bars", "joints", "bare")
WIDTH, MARGIN = 2.0, 15.0  # metres; the ends of the corridor are out of sight


def straight(seed: int, kind: str, length: float) -> World:
    """A corridor along x whose lines are along x, but for what is across by `kind`."""
    rng = np.random.default_rng([seed, 5])
    low, high = -MARGIN, length + MARGIN
    side = WIDTH / 2
    near, wide, board = rng.uniform(0.15, 0.3), rng.uniform(0.06, 0.15), rng.uniform(0.06, 0.13)
    stripes = [rectangle(low, y, high, y + wide) for y in (near - side, side - near - wide)]
    places = np.arange(low + 1, high - 1, rng.uniform(1.8, 3.0))
    at = places if kind == "joints" else places[:0]
    cross = np.array([[[x, -side + 0.4], [x, side - 0.4]] for x in at]).reshape(-1, 2, 2)
    bars = [rectangle(x, 0.4 - side, x + 0.45, side - 0.4) for x in places if kind == "bars"]
    walls = np.array([[[low, -side], [high, -side]], [[high, side], [low, side]]])
    grey = np.full(3, 0.5)
    paint = lambda corners, kinds: Areas(
        np.array(corners), np.tile(0.6 * grey, (len(kinds), 1)), tuple(kinds)
    )
    return dataclasses.replace(
        make_world("l", seed),  # for its look
        name="corridor",
        corridors=np.array([[low, -side, high, side]]),
        walls=walls,
        waypoints=np.array([[0.0, 0.0], [length, 0.0]]),
        floor_areas=paint(stripes + bars, ["stripe"] * 2 + ["mark"] * len(bars)),
        floor_lines=FloorLines(
            cross, np.full(len(at), 0.02), np.tile(0.5 * grey, (len(at), 1)), ("joint",) * len(at)
        ),
        wall_areas=paint([rectangle(0, 0, high - low, board)] * 2, ["baseboard"] * 2),
        wall_of_area=np.arange(2),
        lamps=np.zeros((0, 4)),
        lamp_light=np.zeros(0),
        boxes=np.zeros((0, 5)),
        box_colours=np.zeros((0, 3)),
    )


def run_seeds(seeds: list[int], kind: str, length: float) -> list[dict]:
    """Distance driven, error and spread along the corridor at each image, of every seed."""
    drives = [common.take_drive(straight(s, kind, length), random_setup(s), s) for s in seeds]
    rows = []
    for first in range(0, len(seeds), 5):
        mine = drives[first : first + 5]
        keys = jax.vmap(jax.random.key)(np.array(seeds[first : first + 5], np.uint32))
        infos = jax.device_get(common.run_batch(common.config_of(), *common.stack(mine), keys))
        for i, drive in enumerate(mine):
            T = len(drive.truth.stamps)
            true = common.in_start(drive.truth)
            path = common.path_of(drive, common.one_of(infos.T_world_robot, i))
            rows.append({
                "distance": true[:, 0],
                "error": (path.xy - true[:, :2])[:, 0], "across": (path.xy - true[:, :2])[:, 1],
                "odometry": (common.in_start(drive.odometry) - true)[:, 0],
                "spread": np.sqrt(infos.covariance[i, :T, 0, 0]),
            })  # fmt: skip
    return rows


def what_is_said(seed: int, kind: str, length: float, folder: Path) -> dict:
    """The drawn drive's warnings, and its spread and errors as reported."""
    shutil.rmtree(folder, ignore_errors=True)
    world, setup = straight(seed, kind, length), random_setup(seed)
    record(folder / "drive", world, setup, simulate_run(world, setup, seed), seed=seed)
    run = ["run", str(folder / "drive"), "--out", str(folder / "run"), "--loop", "none"]
    if code := sofjax(run):
        raise SystemExit(code)
    report = json.loads((folder / "run" / "report.json").read_text())
    return {
        "warnings": report["warnings"],
        "longest_without_lines_across_m": report["longest_without_lines_across_m"],
        "ate_m": report["errors"]["trajectory"]["ate_m"],
        "odometry_ate_m": report["errors"]["odometry"]["ate_m"],
    }  # fmt: skip


def summary(rows: list[dict]) -> dict[str, float]:
    end = {name: np.array([row[name][-1] for row in rows]) for name in rows[0]}
    rms = lambda x: float(np.sqrt(np.mean(x**2)))
    return {
        "runs": len(rows),
        "rms_along_m": rms(end["error"]), "rms_across_m": rms(end["across"]),
        "rms_odometry_along_m": rms(end["odometry"]),
        "rms_from_odometry_m": rms(end["error"] - end["odometry"]),
        "spread_m": rms(end["spread"]), "largest_spread_m": float(end["spread"].max()),
        "smallest_spread_m": float(end["spread"].min()),
        "inside_2_sigma": float(np.mean(np.abs(end["error"]) < 2 * end["spread"])),
    }  # fmt: skip


def draw(table: dict[str, list[dict]], path: Path) -> None:
    plot, axes = common.pyplot().subplots(1, 3, figsize=(14, 4), layout="constrained", sharey=True)
    for axis, (kind, rows) in zip(axes, table.items(), strict=True):
        for i, row in enumerate(rows):
            x = row["distance"]
            for name, colour in (("odometry", "#e08e0b"), ("error", "#c0392b")):
                label = {"error": "estimate"}.get(name, name) if i == 0 else None
                axis.plot(x, row[name], color=colour, lw=0.7, label=label)
        mean = np.sqrt(np.mean([np.interp(x, r["distance"], r["spread"] ** 2) for r in rows], 0))
        axis.fill_between(x, -2 * mean, 2 * mean, color="#1f4e9c", alpha=0.25,
                          label="± 2 sigma of the particles")  # fmt: skip
        axis.set(xlabel="metres driven", title=f"across the way: {kind}")
    axes[0].set_ylabel("error along the corridor, m")
    axes[0].legend(fontsize=8)
    plot.savefig(path, dpi=110)


def main() -> None:
    parser = common.options(__doc__, __file__)
    parser.add_argument("--seeds", type=int, default=20)
    args = parser.parse_args()
    seeds, length = (2, 4.0) if args.quick else (args.seeds, 30.0)
    table, results = {}, {}
    for kind in KINDS:
        table[kind] = run_seeds(list(range(args.seed, args.seed + seeds)), kind, length)
        results[kind] = summary(table[kind])
        results[kind]["drawn"] = what_is_said(args.seed, kind, length, args.out / kind)
        print(kind, json.dumps(results[kind], indent=1), flush=True)
    common.save(args.out, "corridor", args, {"length_m": length, "corridors": results})
    draw(table, args.out / "corridor.png")


if __name__ == "__main__":
    main()
