"""Which residual fits the mount best: rho and theta of eq. (9), or distances of the end points?

    python experiments/calibration/residuals.py [--quick] [--logs 200] [--seed FIRST] [--out DIR]

Logs of floor segments with 0.5 px noise from the simulator: random rigs in random worlds, exact
odometry, no vibration. Tracks and pairs are the same for all residuals, and so is the solver.
"""

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
from logs import EXACT_MODEL, cramer_rao, make_log, moved, roughly

from sofjax.calibration import (
    PairNoise,
    SegmentPairs,
    TrackConfig,
    all_distances,
    expected,
    fit_rig,
    follow,
    relate,
    start_at,
)
from sofjax.geometry import (
    SE2,
    Camera,
    Mount,
    line_through,
    polar,
    polar_difference,
    transfer_line,
    two_view_homography,
)
from sofjax.rig import Rig
from sofjax.simulation import make_world
from sofjax.smoothing import robust

NOISE, CAPACITY = 0.5, 1024


@eqx.filter_jit
def polar_fit(
    camera: Camera, mount: Mount, pairs: SegmentPairs, sigma: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The same fit with (rho, theta) of the second segment minus those of the carried line."""
    centre = jnp.eye(3).at[:2, 2].set(-camera.K[:2, 2])

    def one(by: jax.Array, first: jax.Array, second: jax.Array, T: SE2) -> jax.Array:
        there = moved(camera, mount, by).rig.mount
        H = centre @ two_view_homography(camera, there, T) @ jnp.linalg.inv(centre)
        ends = lambda s: s - camera.K[:2, 2]
        carried = transfer_line(H, line_through(*ends(first)))
        return polar_difference(polar(line_through(*ends(second))), polar(carried)) / sigma

    def residuals(by: jax.Array, _: object) -> jax.Array:
        r = jax.vmap(one, (None, 0, 0, 0))(by, pairs.first, pairs.second, pairs.T_first_second)
        return jax.vmap(robust, (0, None))(jnp.where(pairs.valid[:, None], r, 0), 2.0)

    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    by = optx.least_squares(residuals, solver, jnp.zeros(3), max_steps=60, throw=False).value
    J = jax.jacfwd(residuals)(by, None)
    C = jnp.linalg.inv(jnp.einsum("nri,nrj->ij", J, J) + 1e-9 * jnp.eye(3))
    m = moved(camera, mount, by).rig.mount
    unit = jnp.stack([m.height, jnp.ones(()), jnp.ones(())])
    return jnp.stack([m.height, m.pitch, m.roll]), C * jnp.outer(unit, unit)


def endpoint_fit(camera: Camera, mount: Mount, pairs: SegmentPairs) -> tuple[jax.Array, jax.Array]:
    found = fit_rig(start_at(Rig(camera, mount)), pairs)
    m = found.mount
    unit = jnp.stack([m.height, jnp.ones(()), jnp.ones(())])
    return jnp.stack([m.height, m.pitch, m.roll]), found.covariance[:3, :3] * jnp.outer(unit, unit)


def fit_all(
    camera: Camera, mount: Mount, start: Mount, pairs: SegmentPairs, exact: SegmentPairs
) -> tuple[dict, jax.Array]:
    """All three fits of one log, and the bound."""
    constant = jnp.array([5.0, 0.03])  # pixels and radians
    tight = jnp.array([1.0, 0.015])
    return {
        "end points, weighed": endpoint_fit(camera, start, pairs),
        "end points, one sigma": endpoint_fit(camera, start, exact),
        "rho, theta (5 px, 1.7°)": polar_fit(camera, start, pairs, constant),
        "rho, theta (1 px, 0.9°)": polar_fit(camera, start, pairs, tight),
    }, cramer_rao(camera, mount, pairs, jnp.asarray(NOISE))


def study(seed: int) -> tuple[dict, np.ndarray, int, float] | None:
    """Errors, sigmas and the bound of one log; None where it has too few pairs for any fit."""
    camera, mount, log = make_log(make_world("random", seed), seed, NOISE)
    rough = roughly(mount)
    rules = TrackConfig()
    noise = PairNoise(pixel_sigma=NOISE, odometer=EXACT_MODEL)
    # a wrong mount prefers pairs that seem to prove it: that is not what is asked here
    true_rig = start_at(Rig(camera, mount))
    track = follow(rules, true_rig, log)
    pairs, _ = relate(rules, log, track, float(rough.height), CAPACITY)
    if pairs.valid.sum() < 60:
        return None
    # false tracks are the same for all residuals; here there are to be none
    sigma = expected(noise, true_rig, pairs)
    off = all_distances(true_rig, pairs)
    true = pairs.valid & (jnp.abs(off / sigma).max(axis=1) < 5)
    pairs = eqx.tree_at(lambda p: (p.sigma, p.valid), pairs, (sigma, true))
    plain = eqx.tree_at(lambda p: p.sigma, pairs, jnp.full_like(sigma, NOISE * 2**0.5))
    fits, least = fit_all(camera, mount, rough, pairs, plain)
    true_value = np.array([mount.height, mount.pitch, mount.roll])
    rows = {
        name: (np.asarray(value) - true_value, np.sqrt(np.diag(np.asarray(C))))
        for name, (value, C) in fits.items()
    }
    return rows, np.asarray(least), int(true.sum()), float(mount.height)


def main() -> None:
    parser = common.options(__doc__, __file__)
    parser.add_argument("--logs", type=int, default=200)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    begun, done, seed = time.time(), [], args.seed
    logs = 4 if args.quick else args.logs
    while len(done) < logs and seed < args.seed + 3 * logs:
        found = study(seed)
        done += [found] if found else []
        seed += 1
    table = {}
    least = np.array([d[1] for d in done])
    for name in done[0][0]:
        error = np.array([d[0][name][0] for d in done])
        sigma = np.array([d[0][name][1] for d in done])
        table[name] = {
            "height_mm": 1e3 * float(np.sqrt(np.mean(error[:, 0] ** 2))),
            "pitch_mrad": 1e3 * float(np.sqrt(np.mean(error[:, 1] ** 2))),
            "roll_mrad": 1e3 * float(np.sqrt(np.mean(error[:, 2] ** 2))),
            "times_bound": np.sqrt(np.mean((error / least) ** 2, axis=0)).tolist(),
            "inside_2_sigma": np.mean(np.abs(error) < 2 * sigma, axis=0).tolist(),
        }
    print(f"{len(done)} logs of {seed - args.seed}, pairs {min(d[2] for d in done)} to "
          f"{max(d[2] for d in done)}; {time.time() - begun:.0f} s")  # fmt: skip
    print("| residual | height | pitch | roll | times the bound | inside 2 sigma |\n|" + "---|" * 6)
    for name, row in table.items():
        times = ", ".join(f"{v:.2f}" for v in row["times_bound"])
        inside = ", ".join(f"{100 * v:.0f} %" for v in row["inside_2_sigma"])
        print(f"| {name} | {row['height_mm']:.1f} mm | {row['pitch_mrad']:.2f} mrad | "
              f"{row['roll_mrad']:.2f} mrad | {times} | {inside} |")  # fmt: skip
    pairs = [d[2] for d in done]
    common.save(args.out, "residuals", args, {"logs": len(done), "pairs": pairs, "fits": table})
    draw(table, args.out / "residuals.png")


def draw(table: dict, path: Path) -> None:
    plot, axes = common.pyplot().subplots(figsize=(7, 3.2), layout="constrained")
    for i, name in enumerate(("height", "pitch", "roll")):
        at = np.arange(len(table)) + 0.25 * (i - 1)
        axes.barh(at, [row["times_bound"][i] for row in table.values()], 0.25, label=name)
    axes.set_yticks(range(len(table)), list(table))
    axes.invert_yaxis()
    axes.axvline(1, color="black", lw=0.8)
    axes.set_xlabel("root mean square error, times the Cramér-Rao bound")
    axes.legend()
    plot.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
