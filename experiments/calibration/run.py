"""How far off is a fitted mount, how far off may it be, and do its error bars say so?

    python experiments/calibration/run.py [--quick] [--logs 200] [--each 12] [--seed 0] [--out DIR]

Logs of floor segments from the simulator: random worlds and rigs by seed, 160 images. Each is
tracked and fitted from 10 % and 1.7° off by `fit_drive`; nothing is told of what belongs together.
Writes `calibration.json` and `calibration.png`.
"""

import dataclasses
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

sys.path.append(str(Path(__file__).parents[1]))
import common
from logs import EXACT, EXACT_MODEL, cramer_rao, make_log, roughly

from sofjax.calibration import TURNS, DriveFitConfig, FitConfig, PairNoise, TrackConfig, fit_drive
from sofjax.rig import Rig
from sofjax.simulation import Odometer, World, around, furnish, make_world

NOISE, CAPACITY = 0.5, 1024
MOUNT = ("height", "pitch", "roll")


@dataclasses.dataclass(frozen=True)
class Setting:
    """What is varied; the defaults are the base."""

    noise: float = NOISE  # pixels
    longest: float = 2.0  # baseline, heights of the camera
    pairs: int = CAPACITY
    odometer: Odometer = EXACT
    floor: str = ""  # of an L-shaped corridor; else random worlds


def scaled(**factors: float) -> Odometer:
    return dataclasses.replace(EXACT, **factors)


VARIATIONS = {
    "pixel noise, px": {n: Setting(noise=n) for n in (0.125, 0.25, 0.5, 1.0)},
    "baseline, heights of the camera": {b: Setting(longest=b) for b in (0.25, 0.5, 1.0, 2.0)},
    "pairs at most": {n: Setting(pairs=n) for n in (64, 128, 256, 512, 1024)},
    "odometer's distance, read / true": {
        s: Setting(odometer=scaled(distance=s)) for s in (0.96, 0.98, 1.0, 1.02, 1.04)
    },
    "odometer's right turns, read / true": {
        s: Setting(odometer=scaled(right=s)) for s in (1.0, 1.04, 1.08)
    },
    "floor": {
        f: Setting(floor=f) for f in ("tiles", "blocks", "diamonds", "planks", "stripes")
    },
}  # fmt: skip


def corridor(floor: str, seed: int) -> World:
    """An L-shaped corridor with a floor of one's choice."""
    bend = np.array([[0, 0], [0, 9], [8, 9]], float)
    way = np.array([[0, -0.3], [0, 9], [7.6, 9]], float)
    return furnish(floor, around(bend, 2.0), way, floor, np.random.default_rng([seed, 5]))


def fit_rules(setting: Setting) -> DriveFitConfig:
    """The odometer is as exact as it is; its turns are free only where they err."""
    turns = TURNS if setting.odometer.right != 1 else ()
    return DriveFitConfig(
        track=TrackConfig(min_baseline=setting.longest / 4, max_baseline=setting.longest),
        noise=PairNoise(setting.noise, EXACT_MODEL),
        fit=FitConfig(free=(*MOUNT, *turns), pixel_sigma=setting.noise),
        starts=((1.0, 0.0),),
        capacity=setting.pairs,
    )


def study(setting: Setting, seed: int) -> dict:
    """One log: its error, what the fit says of it and the bound; height in metres, radians."""
    world = corridor(setting.floor, seed) if setting.floor else make_world("random", seed)
    camera, mount, log = make_log(world, seed, setting.noise, setting.odometer)
    rules = fit_rules(setting)
    found = fit_drive(Rig(camera, roughly(mount)), log, rules)
    verdict = found.verdict(rules)
    best = float(setting.odometer.distance) * mount.height  # all that can be seen of it
    true = np.array([best, mount.pitch, mount.roll])
    m = found.fit.mount
    error = np.array([m.height, m.pitch, m.roll]) - true
    least = cramer_rao(camera, mount, found.pairs, jnp.asarray(setting.noise))
    return {
        "seed": seed,
        "usable": verdict.usable,
        "why": verdict.sentence,
        "pairs": int(found.pairs.valid.sum()),
        "height": float(mount.height),
        "error": error.tolist(),
        "sigma": (np.sqrt(np.diag(found.covariance))[:3] * [float(m.height), 1, 1]).tolist(),
        "bound": np.asarray(least).tolist(),
    }


def summary(rows: list[dict]) -> dict:
    """Of the answers: root mean squares, coverage; refusals are counted."""
    answers = [row for row in rows if row["usable"]]
    if not answers:
        return {"logs": len(rows), "answers": 0}
    error, sigma, bound = (np.array([r[k] for r in answers]) for k in ("error", "sigma", "bound"))
    height = np.array([r["height"] for r in answers])
    unit = np.stack([height / 100, *[np.full(len(height), np.pi / 180)] * 2], axis=1)
    rms = lambda x: np.sqrt(np.mean(x**2, axis=0)).tolist()
    return {
        "logs": len(rows),
        "answers": len(answers),
        "pairs": float(np.median([r["pairs"] for r in answers])),
        "error": rms(error / unit),  # per cent, degrees, degrees
        "bound": rms(bound / unit),
        "times_bound": rms(error / bound),
        "inside_2_sigma": np.mean(np.abs(error) < 2 * sigma, axis=0).tolist(),
    }


def draw(path: Path, table: dict) -> None:
    plot, all_axes = common.pyplot().subplots(2, 3, figsize=(12, 6.4))
    for (name, cells), axes in zip(table.items(), all_axes.flat, strict=True):
        keys = [k for k in cells if cells[k]["answers"]]
        words = isinstance(next(iter(cells)), str)
        x = np.arange(len(keys)) if words else np.array(keys)
        for i, (what, colour) in enumerate(
            (("height, %", "#1f4e9c"), ("pitch, °", "#c0392b"), ("roll, °", "#3a8f4d"))
        ):
            value = lambda field, i=i, keys=keys, cells=cells: [cells[k][field][i] for k in keys]
            line = "" if words else "-"
            axes.plot(x, value("error"), "o" + line, color=colour, ms=4, label=what)
            axes.plot(x, value("bound"), "_" if words else "--", color=colour, ms=16, lw=1)
        axes.set_yscale("log")
        common.plain_ticks(axes.yaxis)
        if words:
            axes.set_xticks(x, [f"{k}\n{cells[k]['answers']}/{cells[k]['logs']}" for k in keys])
            axes.set_xlim(-0.5, len(keys) - 0.5)
        elif "read" not in name:
            axes.set_xscale("log")
            axes.set_xticks(x, [f"{k:g}" for k in keys])
            axes.minorticks_off()
        else:
            axes.set_xticks(x)
        axes.set_xlabel(name)
        axes.grid(alpha=0.3)
    all_axes[0, 0].legend(fontsize=8)
    plot.supylabel("root mean square error; dashed or bar: Cramér-Rao bound", fontsize=9)
    plot.tight_layout()
    plot.savefig(path, dpi=80)


HEAD = f"{'':48s} logs answers  pairs   error %, °, °            times bound        in 2 sigma, %"


def line_of(name: str, cell: dict) -> str:
    if not cell["answers"]:
        return f"{name:48s} {cell['logs']:4d} {0:7d}"
    error = " ".join(f"{e:7.3f}" for e in cell["error"])
    times = " ".join(f"{t:5.2f}" for t in cell["times_bound"])
    inside = " ".join(f"{100 * v:4.0f}" for v in cell["inside_2_sigma"])
    counts = f"{cell['logs']:4d} {cell['answers']:7d} {cell['pairs']:6.0f}"
    return f"{name:48s} {counts}  {error}  {times}  {inside}"


def main() -> None:
    parser = common.options(__doc__, __file__)
    parser.add_argument("--logs", type=int, default=200, help="of the base")
    parser.add_argument("--each", type=int, default=12, help="logs of a variation")
    options = parser.parse_args()
    logs, each = (4, 1) if options.quick else (options.logs, options.each)
    variations = {
        name: {value: settings[value] for value in list(settings)[:: 4 if options.quick else 1]}
        for name, settings in VARIATIONS.items()
    }
    jax.config.update("jax_enable_x64", True)
    begun = time.process_time()
    seeds = lambda n: range(options.seed, options.seed + n)
    base = [study(Setting(), seed) for seed in seeds(max(logs, each))]
    print(HEAD)
    print(line_of("base", summary(base[:logs])), flush=True)
    table: dict = {}
    for name, settings in variations.items():
        table[name] = {}
        for value, setting in settings.items():
            same = setting == Setting()
            rows = base[:each] if same else [study(setting, seed) for seed in seeds(each)]
            table[name][value] = summary(rows)
            print(line_of(f"{name} {value}", table[name][value]), flush=True)
    results = {
        "processor_seconds": round(time.process_time() - begun),
        "base": summary(base[:logs]),
        "variations": table,
    }
    common.save(options.out, "calibration", options, results)
    draw(options.out / "calibration.png", table)


if __name__ == "__main__":
    main()
