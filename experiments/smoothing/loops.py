"""Fifty loops over blocks every 2.3 m, and fifty drives that never come back: are loops told?

    python experiments/smoothing/loops.py [--quick] [--drives 50] [--seed S] [--out DIR]

Each seed has a ring of corridors, its begin driven again in the end, or a way of as many bends
that does not come back, over a floor that repeats; and a robot of its own. The filter runs at the
default settings on segments, then all is smoothed and loops are looked for. Every drive is kept in
`drives.jsonl`, so that an interrupted study goes on where it was; loops.json and loops.png tell.
"""

import json
import sys
import time
from pathlib import Path

import jax
import numpy as np
from scipy.stats import chi2

sys.path.append(str(Path(__file__).parents[1]))
import common

from sofjax import SofSlam, loop_closure, smoothing
from sofjax.evaluation import evaluate_trajectory
from sofjax.geometry import SE2
from sofjax.io.trajectory import Trajectory
from sofjax.simulation import World, around, furnish, random_setup

FLOORS = ("blocks", "tiles", "stripes", "planks")  # of the drives without a loop
SHARES = (0.25, 0.5, 0.75, 1.0)  # of the way, at which poses are judged
RIGHT = 0.1  # metres by which the end may be off the begin if the loop counts as closed


def make_loop(seed: int, size: float = 1.0) -> World:
    """A ring of 26 m to 64 m, of which 5 m to 9 m are driven twice."""
    rng = np.random.default_rng([seed, 61])
    w, h, width = size * rng.uniform(5, 12), size * rng.uniform(8, 20), rng.uniform(1.9, 2.5)
    ring = np.array([[0, 0], [0, h], [w, h], [w, 0], [0, 0]])
    if rng.random() < 0.5:
        ring[:, 0] *= -1  # counter-clockwise
    again = min(rng.uniform(6, 10), h - 1)
    way = np.concatenate([[[0, 1.0]], ring[1:], [[0, again]]])
    return furnish("loop", around(ring, width), way, "blocks", rng)


def make_way(seed: int, size: float = 1.0) -> World:
    """Stairs of corridors, 30 m to 65 m, over a floor that repeats."""
    rng = np.random.default_rng([seed, 67])
    legs = size * rng.uniform(8, 16, int(rng.integers(3, 5)))
    steps = np.array([[0, 1], [rng.choice([-1, 1]), 0]])[np.arange(len(legs)) % 2]
    way = np.concatenate([[[0, 0]], np.cumsum(legs[:, None] * steps, axis=0)])
    return furnish("way", around(way, rng.uniform(1.9, 2.5)), way, str(rng.choice(FLOORS)), rng)


def drive_one(kind: str, seed: int, size: float) -> dict[str, object]:
    """Run, smooth, close; and what the truth says of it."""
    world = (make_loop if kind == "loop" else make_way)(seed, size)
    drive = common.take_drive(world, random_setup(seed), seed)
    camera, mount, log = common.one_of(common.stack([drive]), 0)
    T, config = len(drive.truth.stamps), common.config_of()
    slam = SofSlam(config, camera, mount)
    state, info = slam.run(slam.init(jax.random.key(seed), common.M), log)
    log, info = jax.tree.map(lambda leaf: np.asarray(leaf)[:T], (log, info))
    begun = time.perf_counter()
    path = common.path_to_smooth(info)
    done = loop_closure.close(config, camera, mount, log, path, state.segment_map)
    seconds = time.perf_counter() - begun
    online = evaluate_trajectory(drive.truth, common.path_of(drive, info.T_world_robot))[0]
    smoothed = common.path_of(drive, done.smoothed.T_world_robot)
    solved = evaluate_trajectory(drive.truth, smoothed)[0]
    solution = done.smoothed.solution
    return {
        "kind": kind, "seed": seed, "floor": common.floor_of(world), "path_m": solved.path_m,
        "odometry_percent": common.odometry_errors(drive).ate_percent,
        "online_percent": online.ate_percent, "smoothed_percent": solved.ate_percent,
        "converged": bool(solution.converged), "keyframes": len(done.smoothed.index),
        "off_m": [apart(drive, path) for path in (info.T_world_robot, smoothed)],
        "closings": sum(r.closing.accepted for r in done.asked),
        "refused": [r.closing.reason for r in done.asked if not r.closing.accepted],
        "nees": nees(drive, smoothed, done.smoothed).tolist(), "seconds": seconds,
    }  # fmt: skip


def apart(drive: common.Drive, path: SE2 | Trajectory) -> float | None:
    """How far the last pose is from where it should be by the pose that came nearest to it, m.

    None where nothing within a metre was passed ten metres earlier.
    """
    T = len(drive.truth.stamps)
    xy, yaw = np.asarray(path.xy, float)[:T], np.asarray(path.yaw, float)[:T]
    way = np.append(0, np.cumsum(np.hypot(*np.diff(drive.truth.xy, axis=0).T)))
    off = np.hypot(*(drive.truth.xy - drive.truth.xy[-1]).T)
    off[way > way[-1] - 10] = np.inf
    near = off.argmin()
    if off[near] > 1:
        return None
    local = lambda xy, yaw: _turned(-yaw[near], xy[-1] - xy[near])
    return float(np.hypot(*(local(xy, yaw) - local(drive.truth.xy, drive.truth.yaw))))


def nees(drive: common.Drive, path: Trajectory, smoothed: smoothing.Smoothed) -> np.ndarray:
    """Normalised squared errors (x, y, yaw) of four keyframes in the frame of the first."""
    index = smoothed.index
    at = np.searchsorted(index, [index[-1] * s for s in SHARES])
    error = common.in_start(path) - common.in_start(drive.truth)
    error[:, 2] = (error[:, 2] + np.pi) % (2 * np.pi) - np.pi
    P = np.asarray(smoothed.solution.pose_covariance)[at][:, :3, :3]
    e = error[index[at]]
    # the solution keeps the first pose; its frame is turned by that pose's heading
    e[:, :2] = _turned(path.yaw[0], e[:, :2])
    return np.einsum("ti,ti->t", e, np.linalg.solve(P, e[..., None])[..., 0])


def _turned(angle: float, xy: np.ndarray) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return xy @ np.array([[c, s], [-s, c]])


def summary(rows: list[dict]) -> dict[str, object]:
    loops, ways = ([r for r in rows if r["kind"] == kind] for kind in ("loop", "way"))
    values = np.array([r["nees"] for r in rows])
    n = len(rows)
    told = {
        "drives": n, "nees_mean": values.mean(axis=0), "nees_median": np.median(values, axis=0),
        "nees_95_of_the_mean": chi2.ppf([0.025, 0.975], 3 * n) / n,
        "nees_within_95": float((values < chi2.ppf(0.95, 3)).mean()),
        "worst": sorted((r["smoothed_percent"], r["kind"], r["seed"]) for r in rows)[-5:],
    }  # fmt: skip
    for kind, some in (("loops", loops), ("ways", ways)):
        if not some:
            continue
        right = [r["off_m"][1] is not None and r["off_m"][1] < RIGHT for r in some]
        accepted = [r["closings"] > 0 for r in some]
        solved = np.array([r["smoothed_percent"] for r in some])
        told[kind] = {
            "drives": len(some), "closed": sum(right), "by_a_constellation": sum(accepted),
            "wrong_closings": sum(a and not r for a, r in zip(accepted, right, strict=True)),
            "within_0.2_percent": float((solved < 0.2).mean()),
            "smoothed_percent": np.percentile(solved, [50, 90, 100]),
            "online_percent": np.percentile([r["online_percent"] for r in some], [50, 90, 100]),
            "odometry_percent": np.percentile([r["odometry_percent"] for r in some], [50, 90, 100]),
            "seconds": float(np.median([r["seconds"] for r in some])),
        }  # fmt: skip
    return told


def draw(rows: list[dict], path: Path) -> None:
    plot, (left, right) = common.pyplot().subplots(1, 2, figsize=(11, 4), layout="constrained")
    for kind, colour in (("loop", "#c0392b"), ("way", "#2471a3")):
        some = [r for r in rows if r["kind"] == kind]
        online, solved = (
            [r[key] for r in some] for key in ("online_percent", "smoothed_percent")
        )  # fmt: skip
        left.plot(online, solved, "o", ms=4, color=colour, label={"way": "no loop"}.get(kind, kind))
        values = np.sort(np.array([r["nees"] for r in some]).ravel())
        right.plot(values, (np.arange(len(values)) + 1) / max(len(values), 1), color=colour)
    low = min(min(r["online_percent"], r["smoothed_percent"]) for r in rows)
    high = max(max(r["online_percent"], r["smoothed_percent"]) for r in rows)
    left.plot([low, high], [low, high], color="grey", lw=0.8)
    left.axhline(0.2, color="grey", ls=":")
    left.set(
        xscale="log", yscale="log", xlabel="ATE while driving, % of the way", ylabel="ATE smoothed"
    )
    for axis in (left.xaxis, left.yaxis):
        common.plain_ticks(axis)
    left.legend()
    x = np.geomspace(0.05, 100, 200)
    right.plot(x, chi2.cdf(x, 3), "k--", label="as it should be")
    right.set(xscale="log", xlabel="NEES of a smoothed pose", ylabel="share of poses below")
    right.legend()
    plot.savefig(path, dpi=110)


def main() -> None:
    parser = common.options(__doc__, __file__)
    parser.add_argument("--drives", type=int, default=50, help="of each kind")
    args = parser.parse_args()
    drives, size = (1, 0.7) if args.quick else (args.drives, 1.0)
    args.out.mkdir(parents=True, exist_ok=True)
    log = args.out / "drives.jsonl"
    rows = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    rows = [] if args.quick else rows
    done = {(r["kind"], r["seed"]) for r in rows}
    for seed in range(args.seed, args.seed + drives):
        for kind in ("loop",) if args.quick else ("loop", "way"):
            if (kind, seed) in done:
                continue
            row = drive_one(kind, seed, size)
            rows.append(row)
            with log.open("a") as file:
                file.write(json.dumps(row) + "\n")
            print(f"{kind} {seed}: {row['online_percent']:.3f} % while driving, "
                  f"{row['smoothed_percent']:.3f} % smoothed, {row['closings']} closed, "
                  f"off by {row['off_m'][1] or float('nan'):.3f} m, "
                  f"NEES {row['nees'][-1]:.1f}, {row['seconds']:.0f} s", flush=True)  # fmt: skip
            jax.clear_caches() if len(rows) % 5 == 0 else None
    told = summary(rows)
    common.save(args.out, "loops", args, told | {"each": rows})
    draw(rows, args.out / "loops.png")
    print(json.dumps(told, indent=1, default=lambda a: np.asarray(a).tolist()))


if __name__ == "__main__":
    main()
