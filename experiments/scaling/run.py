"""What a step costs, by particles, segments of an image, slots of the map, runs, and processes.

    python experiments/scaling/run.py [--quick] [--images 20] [--out DIR]

One stretch of a drive is run with one size changed at a time; compiling is told apart. Then 64
runs of 256 particles over 300 images, one call after the other and all in one call. The last part
shares the particles of one filter among processes by jax.distributed, against one process:
on one machine this shows that the results are the same, not that it is faster, as one process
uses all cores already. On a cluster, start `worker.py` on each machine.
"""

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np

sys.path.append(str(Path(__file__).parents[1]))
import common

jax.config.update("jax_num_cpu_devices", os.cpu_count())  # for many runs: before jax begins

USUAL = {"particles": 1000, "segments": 64, "map": 1024}
SIZES = {
    "particles": (10, 100, 1000, 10_000),
    "segments": (8, 16, 32, 64, 128),
    "map": (64, 256, 1024, 4096),
}
FEW = {"particles": (10, 1000), "segments": (16, 64), "map": (64,)}


def measure(seed: int, images: int, particles: int, segments: int, map: int) -> dict[str, float]:
    """Milliseconds of a step, after it was compiled; and what compiling took."""
    import jax.numpy as jnp

    from sofjax import slam
    from sofjax.geometry import Segments

    drive = common.random_drive("random", seed, images)
    seen = drive.observations.segments_image
    fill = np.resize(np.arange(common.M), segments)  # more are the same again
    observations = jax.tree.map(jnp.asarray, drive.observations)
    repeated = Segments(seen.endpoints[:, fill], seen.valid[:, fill])
    observations = type(observations)(repeated, observations.motion, observations.overflow)
    config = common.config_of(filter={"particles": particles}, segment_map={"capacity": map})
    camera, mount = drive.camera, drive.mount
    state = slam.init(config, camera, mount, jax.random.key(seed), segments)
    begun = time.process_time()
    compiled = slam.run.lower(config, camera, mount, state, observations).compile()
    compiling = time.process_time() - begun
    call = lambda: jax.block_until_ready(compiled(config, camera, mount, state, observations))
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


def many_runs(seed: int, images: int, runs: int, rounds: int = 3) -> dict[str, float]:
    """Seconds of one call for many seeds of the filter, and of a call for each, alternating.

    Every core is a device of its own: runs have nothing to tell each other, so that each device
    takes its share of them. The calls one by one are those of a user: one device, which is free to
    use all cores.
    """
    from jax.sharding import AxisType, NamedSharding, PartitionSpec

    from sofjax import slam

    mesh = jax.make_mesh((len(jax.devices()),), ("runs",), axis_types=(AxisType.Auto,))
    shared = NamedSharding(mesh, PartitionSpec("runs"))

    drive = common.random_drive("random", seed, images)
    args = (drive.camera, drive.mount, jax.tree.map(jax.numpy.asarray, drive.observations))
    config = common.config_of(filter={"particles": 256})
    keys = jax.random.split(jax.random.key(seed), runs)
    of_all = jax.tree.map(lambda a: jax.numpy.broadcast_to(a, (runs, *a.shape)), args)
    of_all, all_keys = jax.device_put((of_all, keys), shared)
    together = lambda: common.run_batch(config, *of_all, all_keys)

    @jax.jit
    def alone(args, key):
        return slam.run(config, *args[:2], slam.init(config, *args[:2], key, common.M), args[2])[1]

    def timed(call):
        c, w = time.process_time(), time.perf_counter()
        jax.block_until_ready(call())
        return time.process_time() - c, time.perf_counter() - w

    calls = lambda: [jax.block_until_ready(alone(args, key)) for key in keys]
    compiling = {
        "one": timed(lambda: alone(args, keys[0])),
        "many": timed(together),
    }
    one, many = np.median([(timed(calls), timed(together))
                           for _ in range(rounds)], axis=0)  # fmt: skip
    return {
        "runs": runs, "images": images, "calls_cpu_s": one[0], "calls_wall_s": one[1],
        "call_cpu_s": many[0], "call_wall_s": many[1], "cpu_ratio": one[0] / many[0],
        "wall_ratio": one[1] / many[1], "first_cpu_s": {k: v[0] for k, v in compiling.items()},
    }  # fmt: skip


def draw(table: dict, path: Path) -> None:
    plot, axes = common.pyplot().subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    for axis, (name, rows) in zip(axes, table.items(), strict=True):
        sizes = [int(size) for size in rows]
        for key, label in (("cpu_ms", "CPU"), ("wall_ms", "wall")):
            axis.plot(sizes, [row[key] for row in rows.values()], "o-", ms=4, label=label)
        others = ", ".join(f"{v} {k}" for k, v in USUAL.items() if k != name)
        axis.set(xscale="log", yscale="log", xlabel=name, ylabel="ms a step", title=others)
        axis.legend()
    plot.savefig(path, dpi=110)


def start(args, processes):
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


def main():
    parser = common.options(__doc__, __file__)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--images", type=int, default=20)
    args = parser.parse_args()
    args.images = 10 if args.quick else args.images
    table = {}
    for name, sizes in (FEW if args.quick else SIZES).items():
        table[name] = {}
        for size in sizes:
            row = measure(args.seed, args.images, **USUAL | {name: size})
            table[name][size] = row
            print(f"{size:7d} {name:10s}" + "".join(f"{k} {v:9.2f}   " for k, v in row.items()),
                  flush=True)  # fmt: skip
    runs = many_runs(args.seed, *(10, 4) if args.quick else (300, 64))
    print(json.dumps(runs, indent=1), flush=True)
    one, many = start(args, 1), start(args, args.processes)
    apart = float(np.abs(np.array(one.pop("xy")) - np.array(many.pop("xy"))).max())
    processes = {"one": one, "many": many, "furthest_apart_m": apart}
    print(json.dumps(processes, indent=1))
    common.save(args.out, "scaling", args, {"steps": table, "runs": runs, "processes": processes})
    draw(table, args.out / "scaling.png")


if __name__ == "__main__":
    main()
