"""What a step costs, by particles, segments of an image, slots of the map, runs, and processes.

    python experiments/speed/step.py [--quick] [--images 20] [--only runs] [--out DIR]

One stretch of a drive is run with one size changed at a time; compiling is told apart. Then 64
runs of 256 particles over 300 images, by `many_runs.py`, one call after the other and all in one
call. The last part
shares the particles of one filter among processes by jax.distributed, against one process:
on one machine this shows that the results are the same, not that it is faster, as one process
uses all cores already. On a cluster, start `worker.py` on each machine.
"""

import argparse
import json
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1]))
import common

USUAL = {"particles": 1000, "segments": 64, "map": 1024}
SIZES = {
    "particles": (10, 100, 1000, 10_000),
    "segments": (8, 16, 32, 64, 128),
    "map": (64, 256, 1024, 4096),
}
FEW = {"particles": (10,), "segments": (16,), "map": (64,)}


def measure(seed: int, images: int, particles: int, segments: int, map: int) -> dict[str, float]:
    """Milliseconds of a step, after it was compiled; and what compiling took."""
    import jax
    import jax.numpy as jnp

    from sofjax import SofSlam
    from sofjax.geometry import Segments

    drive = common.random_drive("random", seed, images)
    seen = drive.observations.segments_image
    fill = np.resize(np.arange(common.M), segments)  # more are the same again
    observations = jax.tree.map(jnp.asarray, drive.observations)
    repeated = Segments(seen.endpoints[:, fill], seen.valid[:, fill])
    observations = type(observations)(repeated, observations.motion, observations.overflow)
    config = common.config_of(filter={"particles": particles}, segment_map={"capacity": map})
    slam = SofSlam(config, drive.camera, drive.mount)
    state = slam.init(jax.random.key(seed), segments)
    begun = time.process_time()
    compiled = SofSlam.run.lower(slam, state, observations).compile()
    compiling = time.process_time() - begun
    call = lambda: jax.block_until_ready(compiled(slam, state, observations))
    call()
    cpu, wall = [], []
    for _ in range(3):
        c, w = time.process_time(), time.perf_counter()
        call()
        cpu.append(time.process_time() - c)
        wall.append(time.perf_counter() - w)
    return {
        "cpu_ms": 1e3 * min(cpu) / images,
        "wall_ms": 1e3 * min(wall) / images,
        "compile_cpu_s": compiling,
        "scratch_mib": compiled.memory_analysis().temp_size_in_bytes / 2**20,
    }


def draw(table: dict, path: Path) -> None:
    plot, axes = common.pyplot().subplots(
        1, 3, figsize=(12, 3.6), layout="constrained", sharey=True
    )
    for axis, (name, rows) in zip(axes, table.items(), strict=True):
        sizes = [int(size) for size in rows]
        for key, label in (("cpu_ms", "CPU"), ("wall_ms", "wall")):
            axis.plot(sizes, [row[key] for row in rows.values()], "o-", ms=4, label=label)
        others = ", ".join(f"{v} {k}" for k, v in USUAL.items() if k != name)
        axis.set(xscale="log", yscale="log", xlabel=name, ylabel="ms a step", title=others)
        common.plain_ticks(axis.yaxis)
        axis.legend()
    plot.savefig(path, dpi=110)


def start(args: argparse.Namespace, processes: int) -> dict:
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    command = [sys.executable, str(Path(__file__).with_name("worker.py")), "--address", address]
    command += ["--processes", str(processes)]
    command += ["--images", str(args.images), "--seed", str(args.seed)]
    workers = [
        subprocess.Popen([*command, "--rank", str(rank)], stdout=subprocess.PIPE, text=True)
        for rank in range(processes)
    ]
    said = [worker.communicate()[0] for worker in workers]
    if any(worker.returncode for worker in workers):
        sys.exit("a process failed")
    return json.loads(said[0].splitlines()[-1])


def steps(args: argparse.Namespace) -> dict[str, dict]:
    table = {}
    for name, sizes in (FEW if args.quick else SIZES).items():
        table[name] = {}
        for size in sizes:
            row = measure(args.seed, args.images, **USUAL | {name: size})
            table[name][size] = row
            print(f"{size:7d} {name:10s}" + "".join(f"{k} {v:9.2f}   " for k, v in row.items()),
                  flush=True)  # fmt: skip
    return table


def runs_of(args: argparse.Namespace) -> dict[str, float]:
    size = ["--images", "10", "--runs", "4"] if args.quick else []
    script = Path(__file__).with_name("many_runs.py")
    command = [sys.executable, str(script), "--seed", str(args.seed), *size]
    said = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
    print(said, flush=True)
    return json.loads(said)


def processes_of(args: argparse.Namespace) -> dict[str, object]:
    one, many = start(args, 1), start(args, args.processes)
    apart = float(np.abs(np.array(one.pop("xy")) - np.array(many.pop("xy"))).max())
    processes = {"one": one, "many": many, "furthest_apart_m": apart}
    print(json.dumps(processes, indent=1))
    return processes


def main() -> None:
    parser = common.options(__doc__, __file__)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--images", type=int, default=20)
    parser.add_argument("--only", choices=("steps", "runs", "processes"), help="one of the parts")
    args = parser.parse_args()
    args.images = 10 if args.quick else args.images
    parts = {"steps": steps, "runs": runs_of, "processes": processes_of}
    told = {name: part(args) for name, part in parts.items() if args.only in (None, name)}
    common.save(args.out, "step", args, told)
    if "steps" in told:
        draw(told["steps"], args.out / "step.png")


if __name__ == "__main__":
    main()
