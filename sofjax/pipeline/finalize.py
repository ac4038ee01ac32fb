"""After the drive: the path and the map solved for once more, from all images together."""

import ctypes
import gc
import sys
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sofjax import loop_closure, smoothing
from sofjax.evaluation import align
from sofjax.extraction.observation import Observation
from sofjax.io.trajectory import Trajectory
from sofjax.motion import BIAS
from sofjax.pipeline.run_log import RunLog
from sofjax.pipeline.stages import Closed, Driven

# where a user says that the drive ends as a loop: the share of lines that must fit, and the lead
AT_THE_END = loop_closure.ClosingConfig(share=0.4, margin=6.0)
SPREAD = 0.5  # metres about its middle that a path needs to show a direction
FOUND = "one place fits, and no other near it"


def close(driven: Driven) -> Closed | None:
    """The drive closed as `settings.loop` says; None if nothing can be solved for."""
    run_log = driven.log
    if len(run_log.stamps) < 2:
        return None
    observations = jax.tree.map(lambda *leaves: np.stack(leaves), *run_log.observations)
    path = smoothing.Path(
        run_log.T_world_robot, jnp.asarray(np.stack(run_log.jitter)), jnp.asarray(run_log.bias)
    )
    _free_memory()
    solve = {"paper": _by_the_paper, "smooth": _smooth}[driven.settings.loop]
    begun = time.perf_counter()
    closed = solve(driven, observations, path)
    if closed is None or not np.isfinite(closed.trajectory.xy).all():
        return None
    closed = _in_the_frame_of(np.array(run_log.poses, float)[:, :2], closed)
    closed.report["seconds"] = time.perf_counter() - begun
    return closed


def _free_memory() -> None:
    """Drop the programs of the drive: with them, compiling the solution needs a third more."""
    jax.clear_caches()
    gc.collect()
    if sys.platform == "linux":  # freed, but kept by the C library
        getattr(ctypes.CDLL(None), "malloc_trim", lambda pad: 0)(0)


def _in_the_frame_of(driven: np.ndarray, closed: Closed) -> Closed:
    """The solution moved so that its path lies nearest to the one known while driving, [T, 2].

    No image observes the world's axes, so they may be chosen; the map then fits both paths.
    """
    if np.sqrt(driven.var(axis=0).sum()) < SPREAD:
        return closed
    path = closed.trajectory
    motion = align(path.xy, driven)
    return Closed(
        Trajectory(path.stamps, motion.apply(path.xy), path.yaw + motion.yaw),
        eqx.tree_at(
            lambda f: f.endpoints_world,
            closed.final,
            motion.apply(np.asarray(closed.final.endpoints_world)),
        ),
        motion.apply(closed.places),
        motion.R @ closed.covariances @ motion.R.T,
        closed.report,
    )


def _smooth(driven: Driven, observations: Observation, path: smoothing.Path) -> Closed:
    """All poses and lines solved for at once, and again with each loop that was found."""
    assert driven.state is not None
    run_log, file = driven.log, driven.drive.camera_file
    closed = loop_closure.close(
        driven.settings.slam, file.camera, file.mount, observations, path,
        driven.state.segment_map,
    )  # fmt: skip
    done, final, asked = closed.smoothed, closed.final, closed.asked
    solution, T, n = done.solution, done.T_world_robot, len(done.index)
    bias = zip(BIAS, solution.unknowns.shared[4:], strict=True)
    end = np.sqrt(np.diag(solution.pose_covariance[n - 1])[:3])
    return Closed(
        Trajectory(np.array(run_log.stamps), np.asarray(T.xy), np.unwrap(T.yaw)),
        final,
        np.asarray(solution.unknowns.pose)[:n, :2],
        np.asarray(solution.pose_covariance)[:n, :2, :2],
        _revisits_report(asked, run_log)
        | {
            "keyframes": n,
            "lines": int(done.lines.valid.sum()),
            "raised": int((done.lines.valid & done.lines.off_floor).sum()),
            "merged": done.merged,
            "segments": int(done.problem.keyframes.known.sum()),
            "cost": [{"before": before, "after": after} for before, after in done.costs],
            "converged": bool(solution.converged),
            "pixel_sigma": float(done.problem.priors.pixel_sigma),
            "odometer": {name: float(value) for name, value in bias},
            "end_sigma": dict(zip(("x_m", "y_m", "yaw_rad"), end.tolist(), strict=True)),
        },
    )


def _by_the_paper(driven: Driven, _: Observation, path: smoothing.Path) -> Closed:
    """The error at the end, distributed evenly along the path; as it was if no loop is found."""
    assert driven.state is not None and driven.final is not None
    run_log, mount, final = driven.log, driven.drive.camera_file.mount, driven.final
    segment_map = driven.state.segment_map
    known = loop_closure.driven(path, mount, segment_map, final)
    last = np.array([len(run_log.stamps) - 1])
    asked = loop_closure.revisits(AT_THE_END, known, last)
    T, endpoints = path.T_world_robot, final.endpoints_world
    for revisit in asked:
        if revisit.closing.accepted:
            T, motion = loop_closure.closed(known, revisit)
            endpoints = np.asarray(loop_closure.moved_lines(known, motion))
    return Closed(
        Trajectory(
            np.array(run_log.stamps), np.asarray(T.xy, float), np.unwrap(T.yaw).astype(float)
        ),
        eqx.tree_at(lambda f: f.endpoints_world, final, endpoints),
        np.zeros((0, 2)),
        np.zeros((0, 2, 2)),
        _revisits_report(asked, run_log) | {"lines": int(segment_map.valid.sum())},
    )


def _revisits_report(asked: list[loop_closure.Revisit], run_log: RunLog) -> dict[str, object]:
    """Every place that was looked for, and why a loop was closed there or refused."""
    rows = []
    for revisit in asked:
        c = revisit.closing
        here = jnp.asarray(run_log.poses[revisit.image][:2], float)
        shift = np.hypot(*(c.T_correction.apply(here) - here))
        row = {"at": run_log.stamps[revisit.image], "since": run_log.stamps[revisit.since]}
        row |= {"accepted": c.accepted, "why": c.reason or FOUND}
        row |= {"lines": c.lines, "matched": c.matched, "lead": c.lead}
        rows.append(row | ({"shift_m": float(shift)} if c.accepted else {}))
    accepted = sum(row["accepted"] for row in rows)
    return {
        "found": len(rows),
        "accepted": accepted,
        "refused": len(rows) - accepted,
        "loops": rows,
    }
