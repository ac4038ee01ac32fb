"""Noise and gates learned by gradient through the filter; do drives kept back gain by it?

    python experiments/learning/run.py [--quick] [--seed S] [--out DIR]

On some drives of random worlds and robots, seen as segments, the evidence of the soft filter is
maximised by BFGS over the logarithms of the sensor's and the motion's noise, alpha, beta and
Theta: from the defaults, from noise that a user has set 4 times too large or too small, and from
the defaults for robots whose mount and odometer are 4 times as noisy, and their segments twice. On
drives kept back the evidence and the error of the trajectory are compared before and after, for
the soft filter and for the usual one. At the defaults the gradient is set against differences of
the evidence, averaged over random numbers. Writes learning.json and learning.png.
"""

import dataclasses
import functools
import math
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

sys.path.append(str(Path(__file__).parents[1]))
import common

from sofjax import SlamConfig
from sofjax.extraction import Observation
from sofjax.geometry import SE2, Camera, Mount
from sofjax.simulation import make_world, random_setup

Batch = tuple[Camera, Mount, Observation]  # of several drives
NOISE = (
    ("sensor", "pixel_sigma"), ("sensor", "tilt_sigma"),
    ("motion", "distance_noise"), ("motion", "lateral_noise"),
    ("motion", "heading_noise"), ("motion", "turn_noise"),
)  # fmt: skip
GATE = (("association", "alpha"), ("association", "beta"), ("association", "gate"))
NAMES = NOISE + GATE
REACH = 1.5  # of a logarithm: a prior about the start, for what the drives tell nothing of
STEP = 0.1  # of a logarithm, of the differences
SHAKY = 4.0  # times the noise of mount and odometer


def shaky_drive(name: str, seed: int, images: int) -> common.Drive:
    """The same world, driven by the same robot in a worse state."""
    setup = random_setup(seed)
    where = lambda o: (o.distance_noise, o.heading_noise, o.turn_noise)
    odometer = eqx.tree_at(
        where, setup.odometer, [SHAKY * noise for noise in where(setup.odometer)]
    )
    setup = dataclasses.replace(setup, odometer=odometer, vibration=SHAKY * setup.vibration)
    detection = dataclasses.replace(common.LSD, noise=2 * common.LSD.noise)
    return common.take_drive(make_world(name, seed), setup, seed, images, detection)


STARTS = {  # times the default noise, and the drives
    "defaults": (1.0, common.random_drive),
    "noise × 4": (4.0, common.random_drive),
    "noise / 4": (0.25, common.random_drive),
    "shaky robots": (1.0, shaky_drive),
}


def soft_config(particles: int) -> SlamConfig:
    return common.config_of(
        filter={"particles": particles, "soft": True, "gate_each": True},
        segment_map={"capacity": 192},
        sensor={"adaptation": 0.0},  # it would hide a wrong sigma
    )


def usual_config(particles: int) -> SlamConfig:
    return common.config_of(filter={"particles": particles}, segment_map={"capacity": 192})


def where(config: SlamConfig) -> list:
    return [getattr(getattr(config, part), name) for part, name in NAMES]


@eqx.filter_jit
def run(base: SlamConfig, x: jax.Array, drives: Batch, keys: jax.Array) -> tuple[jax.Array, SE2]:
    """Evidence a detected segment and poses, for each drive and each key."""
    config = eqx.tree_at(where, jax.tree.map(jnp.asarray, base), list(jnp.exp(x)))
    many = lambda k: common.run_batch(config, *drives, jnp.broadcast_to(k, drives[0].K.shape[:1]))
    info = jax.vmap(many)(keys)
    return info.log_evidence.sum(-1) / info.detected.sum(-1), info.T_world_robot


def learn(
    base: SlamConfig, start: jax.Array, drives: Batch, keys: jax.Array, steps: int
) -> tuple[jax.Array, int]:
    """Maximise the mean evidence of a segment, the random numbers fixed."""
    segments = drives[2].segments_image.valid.sum()

    def loss(x: jax.Array, _: object) -> jax.Array:
        prior = 0.5 * jnp.sum(((x - start) / REACH) ** 2) / segments
        return prior - run(base, x, drives, keys)[0].mean()

    solver = optx.BFGS(rtol=1e-4, atol=1e-4)
    found = optx.minimise(loss, solver, start, max_steps=steps, throw=False)
    return found.value, int(found.stats["num_steps"])


def compare_gradients(
    base: SlamConfig, x: jax.Array, drives: Batch, keys: jax.Array
) -> dict[str, dict]:
    """The mean gradient over the keys against central differences, both with standard errors."""

    @functools.partial(jax.jit, static_argnums=0)
    def over_keys(base: SlamConfig, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        one = lambda x, key: run(base, x, drives, key[None])[0].mean()
        return jax.lax.map(lambda key: jax.value_and_grad(one)(x, key), keys)

    gradients = np.asarray(over_keys(base, x)[1])
    rows = {}
    for i, (part, name) in enumerate(NAMES):
        h = jnp.zeros(len(NAMES)).at[i].set(STEP)
        up, down = (np.asarray(run(base, x + s * h, drives, keys)[0]).mean(1) for s in (1, -1))
        difference = (up - down) / (2 * STEP)
        error = lambda a: float(a.std(ddof=1) / math.sqrt(len(a)))
        g = gradients[:, i]
        apart = g - difference
        rows[f"{part}.{name}"] = {
            "gradient": float(g.mean()), "gradient_error": error(g),
            "difference": float(difference.mean()), "difference_error": error(difference),
            "bias_in_standard_errors": float(apart.mean()) / max(error(apart), 1e-12),
        }  # fmt: skip
    return rows


def judge(
    x: jax.Array, sizes: int, drives: Batch, kept_back: list[common.Drive], keys: jax.Array
) -> dict[str, list]:
    """On the drives kept back: the evidence of each, and its median error by either filter."""
    evidence, poses = run(soft_config(sizes), x, common.stack(kept_back), keys)
    usual = run(usual_config(sizes), x, common.stack(kept_back), keys)[1]
    ate = lambda T: [
        float(np.median([
            common.errors_of(d, common.one_of(common.one_of(T, k), i)).ate_m
            for k in range(len(keys))
        ]))
        for i, d in enumerate(kept_back)
    ]  # fmt: skip
    learned_on = run(soft_config(sizes), x, drives, keys)[0]
    return {
        "evidence_learned_on": float(learned_on.mean()),
        "evidence": np.asarray(evidence.mean(0)).tolist(),
        "ate_soft": ate(poses), "ate_usual": ate(usual),
    }  # fmt: skip


def draw(results: dict, gradients: dict, path: Path) -> None:
    plot, (left, middle, right) = common.pyplot().subplots(
        1, 3, figsize=(14, 4.2), layout="constrained"
    )
    names = [name for _, name in NAMES]
    for k, (start, result) in enumerate(results.items()):
        at = np.arange(len(NAMES)) + 0.2 * (k - 1.5)
        rows = result["settings"].values()
        left.plot([r["start"] / r["defaults"] for r in rows], at, "|", color=f"C{k}", ms=8)
        left.plot([r["learned"] / r["defaults"] for r in rows], at, "o", color=f"C{k}", label=start)
        for key, marker in (("ate_usual", "o"), ("ate_soft", "x")):
            label = f"{start}, {key[4:]}"
            before, after = result["before"][key], result["after"][key]
            right.plot(before, after, marker, color=f"C{k}", ms=5, label=label)
    left.set_yticks(range(len(names)), names)
    left.invert_yaxis()
    left.set_xscale("log", base=2)
    left.set(xlabel="times the default", title="| start, o learned")
    left.axvline(1, color="grey", lw=0.8)
    right.axline((0.02, 0.02), (0.1, 0.1), color="grey", lw=0.8)
    right.set(xscale="log", yscale="log", xlabel="ATE by the start, m", ylabel="ATE as learned, m",
              title="drives kept back")  # fmt: skip
    for i, row in enumerate(gradients.values()):
        for key, marker, shift in (("gradient", "o", -0.12), ("difference", "s", 0.12)):
            middle.errorbar(row[key], i + shift, xerr=2 * row[f"{key}_error"], fmt=marker, ms=4,
                            color="C0" if key == "gradient" else "C1",
                            label=key if i == 0 else None)  # fmt: skip
    middle.set_yticks(range(len(names)), names)
    middle.invert_yaxis()
    middle.set_xscale("symlog", linthresh=1e-2)
    middle.set_xlim(-0.3, 3)
    middle.set(xlabel="by the logarithm, nats a segment; ± 2 standard errors", title="derivative")
    for axis in (left, middle, right):
        axis.legend(fontsize=7)
    plot.savefig(path, dpi=110)


def main() -> None:
    parser = common.options(__doc__, __file__)
    args = parser.parse_args()
    images, count, seeds, steps, N, many = (50, 6, 2, 15, 64, 24)
    starts = STARTS
    if args.quick:
        images, count, seeds, steps, N, many = (15, 2, 2, 2, 16, 2)
        starts = {"noise × 4": STARTS["noise × 4"]}
    seen = range(1000 * args.seed, 1000 * args.seed + 2 * count)
    keys, others = (jax.random.split(jax.random.key(args.seed + i), seeds) for i in (0, 1))
    defaults = jnp.log(jnp.array(where(usual_config(N))))
    results = {}
    for label, (factor, take) in starts.items():
        drives = [take("random", seed, images) for seed in seen]
        learned_on, kept_back = common.stack(drives[:count]), drives[count:]
        start = defaults + jnp.log(factor) * (jnp.arange(len(NAMES)) < len(NOISE))
        begun = time.process_time()
        x, taken = learn(soft_config(N), start, learned_on, keys, steps)
        each = map(jnp.exp, (defaults, start, x))
        results[label] = {
            "steps": taken, "cpu_seconds": time.process_time() - begun,
            "settings": {
                f"{part}.{name}": {"defaults": float(d), "start": float(a), "learned": float(b)}
                for (part, name), d, a, b in zip(NAMES, *each, strict=True)
            },
            "before": judge(start, N, learned_on, kept_back, others),
            "after": judge(x, N, learned_on, kept_back, others),
        }  # fmt: skip
        before, after = results[label]["before"], results[label]["after"]
        for key in ("ate_usual", "ate_soft"):
            results[label][f"ratio_{key}"] = common.ratio_of(after[key], before[key])
        gain = np.array(after["evidence"]) - np.array(before["evidence"])
        results[label]["gain_evidence_kept_back"] = [float(gain.mean()), float(gain.min())]
        said = ("steps", "gain_evidence_kept_back", "ratio_ate_usual", "ratio_ate_soft")
        print(label, {name: results[label][name] for name in said}, flush=True)
    more = jax.random.split(jax.random.key(args.seed + 2), many)
    two = common.stack([common.random_drive("random", seed, images) for seed in seen[:2]])
    gradients = compare_gradients(soft_config(N), defaults, two, more)
    for name, row in gradients.items():
        print(f"{name:24s} gradient {row['gradient']:8.4f} ± {row['gradient_error']:.4f}, "
              f"differences {row['difference']:8.4f} ± {row['difference_error']:.4f}")  # fmt: skip
    sizes = {"images": images, "drives": count, "keys": seeds, "particles": N}
    common.save(args.out, "learning", args, sizes | {"starts": results, "gradients": gradients})
    draw(results, gradients, args.out / "learning.png")


if __name__ == "__main__":
    main()
