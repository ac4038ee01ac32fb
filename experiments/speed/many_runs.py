"""Many runs in one call against one call after the other; JSON on the standard output.

python experiments/speed/many_runs.py [--runs 64] [--images 300] [--rounds 3] [--seed S]
"""

import argparse
import dataclasses
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

# every core a device; before jax begins
os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={os.cpu_count()}"

import jax
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

sys.path.append(str(Path(__file__).parents[1]))
import common

from sofjax import SofSlam
from sofjax.extraction import Observation
from sofjax.slam import StepInfo

TOGETHER = 16  # runs side by side on a core: what they work on then fits into its cache


def trimmed(log: Observation) -> Observation:
    """A log [T, M] with no more places for segments than its fullest image needs, in eights."""
    needed = np.flatnonzero(np.asarray(log.segments_image.valid).any(axis=0)).max(initial=0) + 1
    M = 8 * -(-needed // 8)
    segments_image = jax.tree.map(lambda leaf: jax.numpy.asarray(leaf[:, :M]), log.segments_image)
    return dataclasses.replace(log, segments_image=segments_image)


def many_runs(seed: int, images: int, runs: int, rounds: int = 3) -> dict[str, float]:
    """Seconds of one call for many seeds of the filter, and of a call for each, alternating.

    Every core is a device of its own: runs have nothing to tell each other, so that each device
    takes its share of them. The calls one by one are those of the README, `SofSlam.init`
    and `SofSlam.run`: one device, which may use all cores.
    """
    drive = common.random_drive("random", seed, images)
    log = trimmed(drive.observations)
    M = log.segments_image.valid.shape[1]
    config = common.config_of(filter={"particles": 256})
    keys = jax.random.split(jax.random.key(seed), runs)

    def run(log: Observation, key: jax.Array) -> StepInfo:
        slam = SofSlam(config, drive.camera, drive.mount)
        return slam.run(slam.init(key, M), log)[1]

    def share(log: Observation, keys: jax.Array) -> StepInfo:
        return jax.lax.map(lambda key: run(log, key), keys, batch_size=TOGETHER)

    mesh = jax.make_mesh((len(jax.devices()),), ("runs",), axis_types=(AxisType.Auto,))
    copied, shared = PartitionSpec(), PartitionSpec("runs")
    on_all_devices = jax.jit(
        jax.shard_map(
            share, mesh=mesh, in_specs=(copied, shared), out_specs=shared, check_vma=False
        )
    )
    log_of_all, keys_of_all = (
        jax.device_put(a, NamedSharding(mesh, spec)) for a, spec in ((log, copied), (keys, shared))
    )
    together = lambda: on_all_devices(log_of_all, keys_of_all)

    def timed(call: Callable[[], object]) -> tuple[float, float]:
        c, w = time.process_time(), time.perf_counter()
        jax.block_until_ready(call())
        return time.process_time() - c, time.perf_counter() - w

    calls = lambda: [jax.block_until_ready(run(log, key)) for key in keys]
    compiling = {"one": timed(lambda: run(log, keys[0])), "many": timed(together)}
    one, many = np.median([(timed(calls), timed(together))
                           for _ in range(rounds)], axis=0)  # fmt: skip
    return {
        "runs": runs, "images": images, "segments": M,
        "calls_cpu_s": one[0], "calls_wall_s": one[1],
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
