"""Many runs in one call against one call after the other; JSON on the standard output.

python experiments/scaling/many_runs.py [--runs 64] [--images 300] [--rounds 3] [--seed S]
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path

# every core a device; before jax begins
os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={os.cpu_count()}"

import jax
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

sys.path.append(str(Path(__file__).parents[1]))
import common

from sofjax import slam


def many_runs(seed: int, images: int, runs: int, rounds: int = 3) -> dict[str, float]:
    """Seconds of one call for many seeds of the filter, and of a call for each, alternating.

    Every core is a device of its own: runs have nothing to tell each other, so that each device
    takes its share of them. The calls one by one are those of a user: one device, which is free to
    use all cores.
    """
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
    compiling = {"one": timed(lambda: alone(args, keys[0])), "many": timed(together)}
    one, many = np.median([(timed(calls), timed(together))
                           for _ in range(rounds)], axis=0)  # fmt: skip
    return {
        "runs": runs, "images": images, "calls_cpu_s": one[0], "calls_wall_s": one[1],
        "call_cpu_s": many[0], "call_wall_s": many[1], "cpu_ratio": one[0] / many[0],
        "wall_ratio": one[1] / many[1], "first_cpu_s": {k: v[0] for k, v in compiling.items()},
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=64, help="a multiple of the number of cores")
    parser.add_argument("--images", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=3, help="of which the median counts")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    print(json.dumps(many_runs(args.seed, args.images, args.runs, args.rounds), indent=1))


if __name__ == "__main__":
    main()
