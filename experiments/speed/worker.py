"""One process of a filter whose particles are shared by jax.distributed; started by run.py.

python experiments/speed/worker.py --rank R --processes P --address HOST:PORT
"""

import argparse
import json
import sys
import time
from pathlib import Path

import jax
import numpy as np

sys.path.append(str(Path(__file__).parents[1]))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rank", type=int, required=True)
    parser.add_argument("--processes", type=int, required=True)
    parser.add_argument("--address", metavar="HOST:PORT", required=True)
    parser.add_argument("--images", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    if args.processes > 1:
        jax.distributed.initialize(args.address, args.processes, args.rank)
    import common  # makes arrays, which must wait for the line above

    from sofjax import SofSlam
    from sofjax.slam import shard

    # the same in every process: a drive seen as segments, and the first state
    drive = common.random_drive("random", args.seed, args.images)
    camera, mount, log = drive.camera, drive.mount, drive.observations
    config = common.config_of(filter={"particles": 1024}, segment_map={"capacity": 128})
    state = SofSlam(config, camera, mount).init(jax.random.key(args.seed), common.M)

    auto = (jax.sharding.AxisType.Auto,)
    mesh = jax.make_mesh((jax.device_count(),), ("particles",), axis_types=auto)
    copied = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
    state = shard(state, mesh)
    camera, mount, log = jax.jit(lambda a: a, out_shardings=copied)((camera, mount, log))
    slam = SofSlam(config, camera, mount)
    jax.block_until_ready(slam.run(state, log))  # compiled
    begun = time.perf_counter()
    state, info = jax.block_until_ready(slam.run(state, log))
    seconds = time.perf_counter() - begun
    if args.rank == 0:
        held = [shard.data.shape[0] for shard in state.particles.log_weight.addressable_shards]
        result = {"devices": jax.device_count(), "particles_held": held, "seconds": seconds}
        result["xy"] = np.asarray(info.T_world_robot.xy, float).tolist()
        print(json.dumps(result))


if __name__ == "__main__":
    main()
