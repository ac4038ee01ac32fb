"""What the studies share: their options, drives seen as segments, batches of runs, results."""

import argparse
import dataclasses
import datetime
import functools
import json
import os
import platform
import subprocess
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import t

from sofjax import PRESETS, SlamConfig, SofSlam, smoothing
from sofjax.evaluation import TrajectoryErrors, evaluate_trajectory
from sofjax.extraction import Observation
from sofjax.geometry import SE2, Camera, Mount
from sofjax.io.trajectory import Trajectory
from sofjax.simulation import (
    Detection,
    RobotSetup,
    Scene,
    World,
    make_world,
    observe,
    random_setup,
    simulate_run,
)
from sofjax.slam import StepInfo

M = 64  # segments an image
LSD = Detection()


def options(doc: str, file: str) -> argparse.ArgumentParser:
    """The options that all studies have; `file` is the script."""
    folder = Path("runs") / name_of(file)
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a minute or so, to see that it works")
    parser.add_argument("--seed", type=int, default=0, help="the first of the seeds")
    parser.add_argument("--out", type=Path, default=folder, help=f"default: {folder}/")
    return parser


def name_of(file: str) -> str:
    """The name of a study: its script's, or its folder's if the script is `run.py`."""
    path = Path(file)
    return path.parent.name if path.stem == "run" else path.stem


def save(out: Path, name: str, args: argparse.Namespace, results: dict) -> None:
    """`<name>.json`: the results, and by what they were made."""
    out.mkdir(parents=True, exist_ok=True)
    git = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True).stdout.strip() or None
    made = {
        "date": datetime.date.today().isoformat(),
        "commit": commit,
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, {jax.default_backend()}",
        "jax": jax.__version__,
        "options": {key: value for key, value in vars(args).items() if key != "out"},
    }
    text = json.dumps({"made": made} | results, indent=1, default=_plain)
    (out / f"{name}.json").write_text(text + "\n")


def _plain(value: object) -> object:
    return str(value) if isinstance(value, Path) else np.asarray(value).tolist()


def config_of(preset: str = "default", **changes: dict[str, object]) -> SlamConfig:
    """A preset with some settings changed: `config_of(filter={"particles": 300})`."""
    config = PRESETS[preset]
    parts = {
        part: dataclasses.replace(getattr(config, part), **given) for part, given in changes.items()
    }
    return dataclasses.replace(config, **parts)


class Drive(NamedTuple):
    """A simulated run seen as segments, without images."""

    camera: Camera
    mount: Mount
    observations: Observation  # leading T
    truth: Trajectory
    odometry: Trajectory  # at the images


def take_drive(
    world: World,
    setup: RobotSetup,
    seed: int,
    images: int | None = None,
    detection: Detection = LSD,
) -> Drive:
    """Drive `setup` through `world` and see it as segments."""
    simulated = simulate_run(world, setup, seed, max_images=images)
    camera, mount = setup.camera_file.camera, setup.camera_file.mount
    edges = sum(
        len(kind.contrast)
        for kind in (world.floor_segments, world.off_floor_segments, world.reflections)
    )
    scene = Scene.of(world, edges=2048 * -(-edges // 2048), walls=64 * -(-len(world.walls) // 64))
    T = len(simulated.truth.stamps)
    padded = lambda leaf: jnp.concatenate([leaf, jnp.repeat(leaf[-1:], -T % 100, axis=0)])
    given = jax.tree.map(padded, (simulated.mounts, simulated.poses(), simulated.motions()))
    seen = _observe(scene, camera, *given, jax.random.key(seed), detection)
    observations = jax.tree.map(lambda leaf: np.asarray(leaf[:T]), seen)
    return Drive(
        camera, mount, observations, simulated.truth, simulated.odometry.at(simulated.truth.stamps)
    )


@jax.jit
def _observe(
    scene: Scene,
    camera: Camera,
    mounts: Mount,
    poses: SE2,
    motions: SE2,
    key: jax.Array,
    detection: Detection,
) -> Observation:
    return observe(scene, camera, mounts, poses, motions, key, detection, capacity=M)


def random_drive(name: str, seed: int, images: int | None = None) -> Drive:
    """A world of that name and a robot unlike others, both by the seed."""
    return take_drive(make_world(name, seed), random_setup(seed), seed, images)


def stack(drives: list[Drive]) -> tuple[Camera, Mount, Observation]:
    """Drives as one batch; the shorter ones stand still and see nothing at their end."""
    T = max(len(drive.truth.stamps) for drive in drives)
    T = 50 * -(-T // 50)  # fewer lengths to compile for
    pad = lambda leaf: np.pad(leaf, [(0, T - len(leaf))] + [(0, 0)] * (leaf.ndim - 1))
    logs = [jax.tree.map(pad, drive.observations) for drive in drives]
    each = [(d.camera, d.mount, log) for d, log in zip(drives, logs, strict=True)]
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(a) for a in leaves]), *each)


@jax.jit
def run_batch(
    config: SlamConfig, camera: Camera, mount: Mount, observations: Observation, keys: jax.Array
) -> StepInfo:
    """The filter on every drive of a batch, each with its key; infos [drives, T]."""

    def one(camera: Camera, mount: Mount, observations: Observation, key: jax.Array) -> StepInfo:
        slam = SofSlam(config, camera, mount)
        return slam.run(slam.init(key, M), observations)[1]

    return jax.vmap(one)(camera, mount, observations, keys)


def path_of(drive: Drive, poses: SE2) -> Trajectory:
    """Estimates (leading T or more) as a trajectory."""
    T = len(drive.truth.stamps)
    xy, yaw = (np.asarray(a, float)[:T] for a in (poses.xy, poses.yaw))
    return Trajectory(drive.truth.stamps, xy, yaw)


def errors_of(drive: Drive, poses: SE2) -> TrajectoryErrors:
    """`TrajectoryErrors` of the estimates."""
    return evaluate_trajectory(drive.truth, path_of(drive, poses))[0]


def odometry_errors(drive: Drive) -> TrajectoryErrors:
    """`TrajectoryErrors` of the odometry alone."""
    return evaluate_trajectory(drive.truth, drive.odometry)[0]


def ratio_of(errors: np.ndarray, others: np.ndarray) -> tuple[float, float, float]:
    """Geometric mean of the ratios of paired errors, and its 95 % interval by Student's t."""
    logs = np.log(np.asarray(errors) / np.asarray(others))
    n = len(logs)
    half = t.ppf(0.975, n - 1) * logs.std(ddof=1) / n**0.5 if n > 1 else np.inf
    low, middle, high = np.exp(logs.mean() + half * np.array([-1, 0, 1]))
    return float(middle), float(low), float(high)


FLOORS = {"mark": "blocks", "grout": "tiles", "plank": "planks", "stripe": "stripes"}


def floor_of(world: World) -> str:
    """blocks, tiles, diamonds, planks, stripes or bare."""
    for kind, floor in FLOORS.items():
        if kind in world.floor_segments.kinds:
            d = np.diff(world.floor_lines.endpoints, axis=1)[:, 0]
            slanted = len(d) and abs(d[0]).min() > 1e-6
            return "diamonds" if floor == "tiles" and slanted else floor
    return "bare"


def path_to_smooth(info: StepInfo) -> smoothing.Path:
    """What the smoother starts from, of the infos [T] of a whole run."""
    return smoothing.Path(info.T_world_robot, info.jitter, info.bias[-1])


def one_of(batch: Any, i: int) -> Any:
    """One element of a batch."""
    return jax.tree.map(lambda leaf: leaf[i], batch)


def in_start(path: Trajectory) -> np.ndarray:
    """Poses [T, 3] in the frame of the first, which is where the filter begins."""
    c, s = np.cos(path.yaw[0]), np.sin(path.yaw[0])
    xy = (path.xy - path.xy[0]) @ np.array([[c, -s], [s, c]])
    return np.column_stack([xy, path.yaw - path.yaw[0]])


@functools.cache
def pyplot() -> ModuleType:
    """matplotlib without a screen."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def plain_ticks(axis: Any) -> None:
    """A logarithmic axis at 1, 2, 5 and so on, in numbers as one writes them."""
    from matplotlib.ticker import LogLocator, NullLocator

    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter("{x:g}")
