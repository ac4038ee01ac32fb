"""One filter on several processes, its particles shared by jax.distributed; against one process.

    python run.py [--processes 2] [--particles 4096] [--images 40]

On one machine this shows that the results are the same, not that it is faster: one process uses
all its cores already. On a cluster, start `--worker RANK --address HOST:PORT` on each machine.
"""

import argparse
import json
import socket
import subprocess
import sys
import time

import numpy as np


def work(args):
    import jax

    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    if args.processes > 1:
        jax.distributed.initialize(args.address, args.processes, args.worker)

    import dataclasses

    from sofjax import PRESETS, slam
    from sofjax.simulation import Scene, make_world, observe, random_rig, take_ride

    # the same in every process: a drive seen as segments, and the first state
    world, rig = make_world("random", args.seed), random_rig(args.seed)
    ride = take_ride(world, rig, args.seed, most_images=args.images)
    camera, mount = rig.camera_file.camera, rig.camera_file.mount
    key = jax.random.key(args.seed)
    see = jax.jit(observe)
    log = see(Scene.of(world), camera, ride.mounts, ride.poses(), ride.motions(), key)
    config = PRESETS["default"]
    config = dataclasses.replace(
        config,
        filter=dataclasses.replace(config.filter, particles=args.particles),
        segment_map=dataclasses.replace(config.segment_map, capacity=128),
    )
    state = slam.init(config, camera, mount, key, 64)

    auto = (jax.sharding.AxisType.Auto,)
    mesh = jax.make_mesh((jax.device_count(),), ("particles",), axis_types=auto)
    copied = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
    state = slam.distribute(state, mesh)
    camera, mount, log = jax.jit(lambda a: a, out_shardings=copied)((camera, mount, log))
    jax.block_until_ready(slam.run(config, camera, mount, state, log))  # compiled
    begun = time.perf_counter()
    state, info = jax.block_until_ready(slam.run(config, camera, mount, state, log))
    seconds = time.perf_counter() - begun
    if args.worker == 0:
        held = [shard.data.shape[0] for shard in state.particles.log_weight.addressable_shards]
        result = {"devices": jax.device_count(), "particles_held": held, "seconds": seconds}
        result["xy"] = np.asarray(info.T_world_robot.xy, float).tolist()
        print(json.dumps(result))


def start(args, processes):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    command = [sys.executable, __file__, "--processes", str(processes), "--address", address]
    command += ["--particles", str(args.particles), "--images", str(args.images)]
    command += ["--seed", str(args.seed)]
    workers = [
        subprocess.Popen([*command, "--worker", str(rank)], stdout=subprocess.PIPE, text=True)
        for rank in range(processes)
    ]
    said = [worker.communicate()[0] for worker in workers]
    if any(worker.returncode for worker in workers):
        sys.exit("a process failed")
    return json.loads(said[0].splitlines()[-1])


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--particles", type=int, default=4096)
    parser.add_argument("--images", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worker", type=int, metavar="RANK")
    parser.add_argument("--address", metavar="HOST:PORT")
    args = parser.parse_args()
    if args.worker is not None:
        return work(args)
    one, many = start(args, 1), start(args, args.processes)
    apart = float(np.abs(np.array(one.pop("xy")) - np.array(many.pop("xy"))).max())
    print(json.dumps({"one": one, "many": many, "furthest_apart_m": apart}, indent=1))


if __name__ == "__main__":
    main()
