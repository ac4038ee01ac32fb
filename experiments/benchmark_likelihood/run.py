"""How fast is the likelihood of many particles? Every form of it in one alternating run.

    python experiments/benchmark_likelihood/run.py                       # the table of the README
    python experiments/benchmark_likelihood/run.py --quick
    python experiments/benchmark_likelihood/run.py --problem FILE.npz --out FILE.npz --json

A problem holds particles [N, 3] (x, y, yaw), observed [M, 4] (x1 y1 x2 y2, robot frame, metres),
map [K, 4] (world), observed_valid [M], map_valid [K], sigma_rho, sigma_theta and e_max. With
--problem the log-likelihoods are written to --out, and what the library's own choice costs is
`cpu_ms`; without it --out is a folder, for the figures as JSON and drawn.
"""

import argparse
import json
import platform
import resource
import statistics
import sys
import time
from pathlib import Path

import jax
import numpy as np

sys.path.append(str(Path(__file__).parents[1]))
import common
from forms import ANYWHERE, TRACKING, arguments, forms, make_problem

import sofjax

TABLE = ((10_000, 30, 100, TRACKING), (10_000, 30, 400, TRACKING), (10_000, 30, 100, ANYWHERE))
QUICK = ((500, 20, 60, TRACKING),)


def time_in_turn(calls: dict, rounds: int, least: float = 0.02) -> dict:
    """Median CPU and wall milliseconds of a call; all in every round, so that they meet the same.

    What takes a quarter of a second or more is left out after three rounds.
    """
    cpu, wall = {name: [] for name in calls}, {name: [] for name in calls}
    repeats = {}
    for name, call in calls.items():
        call()
        start = time.perf_counter()
        call()
        repeats[name] = max(1, int(least / (time.perf_counter() - start)))
    for turn in range(rounds):
        for name, call in calls.items():
            if turn >= 3 and wall[name][0] > 250:
                continue
            w, c = time.perf_counter(), time.process_time()
            for _ in range(repeats[name]):
                call()
            cpu[name].append(1e3 * (time.process_time() - c) / repeats[name])
            wall[name].append(1e3 * (time.perf_counter() - w) / repeats[name])
    median = statistics.median
    return {name: {"cpu_ms": median(cpu[name]), "wall_ms": median(wall[name])} for name in calls}


def benchmark(problem: dict, rounds: int, without: tuple[str, ...] = ()) -> dict:
    made = {name: form for name, form in forms(problem).items() if name not in without}
    figures = time_in_turn({name: call for name, (call, _, _) in made.items()}, rounds)
    pairs = len(problem["particles"]) * len(problem["observed"]) * len(problem["map"])
    for name, (_, scratch, seconds) in made.items():
        figures[name] |= {
            "pairs_per_second": pairs / figures[name]["wall_ms"] * 1e3,
            "scratch_share_of_all_pairs": scratch / (4 * pairs),
            "compile_seconds": seconds,
            "cpu_ratio_to_library": figures[name]["cpu_ms"] / figures["library"]["cpu_ms"],
        }
    return figures


def show(title: str, figures: dict) -> None:
    print(f"\n{title}")
    print(f"{'':48s} CPU ms  wall ms   ratio  pairs/s  scratch  compile s")
    for name, f in figures.items():
        print(
            f"{name:48s} {f['cpu_ms']:6.2f} {f['wall_ms']:8.2f} {f['cpu_ratio_to_library']:7.2f} "
            f"{f['pairs_per_second']:8.2g} {f['scratch_share_of_all_pairs']:7.1%} "
            f"{f['compile_seconds']:10.2f}"
        )


def draw(problems: dict, path: Path) -> None:
    plot, axes = common.pyplot().subplots(figsize=(8, 5), layout="constrained")
    names = list(next(iter(problems.values())))
    for i, (title, figures) in enumerate(problems.items()):
        at = np.arange(len(names)) + 0.8 * i / len(problems)
        axes.barh(at, [figures[f]["cpu_ms"] for f in names], 0.8 / len(problems), label=title)
    axes.set_yticks(np.arange(len(names)) + 0.3, names)
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="CPU milliseconds of a call")
    axes.legend(fontsize=8, loc="lower right", bbox_to_anchor=(1, 1), ncols=len(problems))
    plot.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--problem", metavar="FILE.npz", help="evaluate this instead of the table")
    parser.add_argument("--out", type=Path, help="FILE.npz for log_likelihood [N], or a folder")
    parser.add_argument("--size", metavar="NxMxK", help="one problem of this size")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--quick", action="store_true", help="a small problem, few rounds")
    parser.add_argument("--json", action="store_true", help="figures as JSON on standard output")
    options = parser.parse_args()
    rounds = 3 if options.quick else options.rounds

    result = {
        "device": jax.devices()[0].device_kind,
        "machine": platform.processor(),
        "jax": jax.__version__,
    }
    if options.problem:
        problem = dict(np.load(options.problem))
        figures = benchmark(problem, rounds, without=("chunked numpy", "naive triple vmap"))
        if options.out:
            values = jax.jit(sofjax.log_likelihood)(*arguments(problem))
            np.savez(options.out, log_likelihood=np.asarray(values))
        result |= {"cpu_ms": figures["library"]["cpu_ms"], "forms": figures}
        problems = {options.problem: figures}
    else:
        sizes = QUICK if options.quick else TABLE
        if options.size:
            sizes = ((*map(int, options.size.split("x")), TRACKING),)
        problems = {}
        for *size, cloud in sizes:
            title = "x".join(map(str, size)) + ", " + cloud
            problems[title] = benchmark(make_problem(*size, cloud, options.seed), rounds)
        result["problems"] = problems
        if options.out:
            common.save(options.out, "benchmark_likelihood", options, result)
            draw(problems, options.out / "benchmark_likelihood.png")
    result["peak_memory_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if options.json:
        print(json.dumps(result, indent=1))
        return
    for title, figures in problems.items():
        show(title, figures)
    print(
        f"\npeak memory {result['peak_memory_mib']:.0f} MiB, "
        f"{result['device']}, jax {result['jax']}"
    )


if __name__ == "__main__":
    main()
