"""A long drive, every corridor of it twice: what does it cost to run and to smooth?

    python experiments/smoothing/long_drive.py [--quick] [--rings 16] [--seed S] [--out DIR]

Rings of corridors beside each other, each driven twice before the next, over dark blocks every
2.3 m, seen as segments. long_drive.json has the seconds, the peak of the memory and the errors;
long_drive.png the map, and the errors along the way.
"""

import json
import resource
import sys
import time
from pathlib import Path

import jax
import numpy as np

sys.path.append(str(Path(__file__).parents[1]))
import common

from sofjax import SofSlam, smoothing
from sofjax.evaluation import evaluate_trajectory
from sofjax.geometry import SE2
from sofjax.simulation import World, around, furnish, random_setup

WIDTH, HEIGHT, GAP = 7.0, 11.0, 5.0  # metres, of a ring and to the next


def make_rings(seed: int, rings: int) -> World:
    rng = np.random.default_rng([seed, 71])
    way = [[0, 0]]
    for left in (WIDTH + GAP) * np.arange(rings):
        right = left + WIDTH
        lap = [[left, HEIGHT], [right, HEIGHT], [right, 0]]
        way += [*lap, [left, 0], *lap, [right + GAP, 0]]
    way = np.array(way, float)
    return furnish("rings", around(way, 2.2), way, "blocks", rng)


def peak() -> float:
    """GiB that this process held at most until now."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def draw(drive: common.Drive, online: SE2, done: smoothing.Smoothed, path: Path) -> None:
    from matplotlib.collections import LineCollection

    plot, (above, below) = common.pyplot().subplots(2, 1, figsize=(11, 5.5), layout="constrained")
    ends = np.asarray(done.endpoints_world)[done.lines.valid & ~done.lines.off_floor]
    turned = lambda xy: np.stack([-xy[..., 1], xy[..., 0]], axis=-1)  # the rings beside each other
    above.add_collection(LineCollection(turned(ends), colors="#1f618d", lw=0.7))
    above.plot(*turned(common.in_start(drive.truth)).T, color="black", lw=0.5)
    above.set(xlabel="m to the right", ylabel="m ahead", aspect="equal",
              title="the smoothed map and the true way, in the frame of the start")  # fmt: skip
    way = np.append(0, np.cumsum(np.hypot(*np.diff(drive.truth.xy, axis=0).T)))
    for poses, label in ((online, "while driving"), (done.T_world_robot, "smoothed")):
        off = common.in_start(common.path_of(drive, poses)) - common.in_start(drive.truth)
        below.plot(way, np.hypot(off[:, 0], off[:, 1]), label=label)
    below.set(xlabel="m driven", ylabel="off in the frame of the start, m")
    below.legend()
    plot.savefig(path, dpi=110)


def main() -> None:
    parser = common.options(__doc__, __file__)
    parser.add_argument("--rings", type=int, default=16)
    args = parser.parse_args()
    args.rings = 1 if args.quick else args.rings
    drive = common.take_drive(make_rings(args.seed, args.rings), random_setup(args.seed), args.seed)
    config = common.config_of(segment_map={"capacity": 8192})
    camera, mount, log = common.one_of(common.stack([drive]), 0)
    told = {"images": len(drive.truth.stamps), "peak_gib": {"observed": peak()}, "seconds": {}}
    told["driven_s"] = float(np.ptp(drive.truth.stamps))

    begun = time.perf_counter()
    slam = SofSlam(config, camera, mount)
    start = slam.init(jax.random.key(args.seed), common.M)
    state, info = jax.block_until_ready(slam.run(start, log))
    log, info = jax.tree.map(lambda a: np.asarray(a)[: told["images"]], (log, info))
    segment_map = jax.device_get(state.segment_map)
    told["seconds"]["filter"] = time.perf_counter() - begun
    told["peak_gib"]["filtered"] = peak()

    del start, state
    jax.clear_caches()
    begun, cpu = time.perf_counter(), time.process_time()
    path = common.path_to_smooth(info)
    done = smoothing.smooth(config, camera, mount, log, path, segment_map)
    told["seconds"]["smoothing"] = time.perf_counter() - begun
    told["seconds"]["smoothing_cpu"] = time.process_time() - cpu
    told["peak_gib"]["smoothed"] = peak()

    error = lambda poses: evaluate_trajectory(drive.truth, common.path_of(drive, poses))[0]
    online, solved = error(info.T_world_robot), error(done.T_world_robot)
    told |= {
        "path_m": solved.path_m, "keyframes": len(done.index),
        "lines": int(segment_map.valid.sum()), "lines_smoothed": int(done.lines.valid.sum()),
        "converged": bool(done.solution.converged),
        "odometry_percent": common.odometry_errors(drive).ate_percent,
        "online_percent": online.ate_percent, "smoothed_percent": solved.ate_percent,
    }  # fmt: skip
    common.save(args.out, "long_drive", args, told)
    draw(drive, info.T_world_robot, done, args.out / "long_drive.png")
    print(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()
