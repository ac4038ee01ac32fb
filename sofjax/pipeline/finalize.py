"""After the drive: the path and the map once more, with all that was seen in the end."""

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
from sofjax.io.drive import Drive
from sofjax.io.trajectory import Trajectory
from sofjax.pipeline.run_log import Closed, RunLog
from sofjax.pipeline.settings import RunSettings
from sofjax.segment_map import FinalMap
from sofjax.slam.state import SlamState

# where a user says that the drive ends as a loop: the share of lines that must fit, and the lead
TOLD = loop_closure.ClosingConfig(share=0.4, margin=6.0)
SPREAD = 0.5  # metres about its middle that a path needs to show a direction


def close(
    drive: Drive, settings: RunSettings, run_log: RunLog, state: SlamState, driven: FinalMap
) -> Closed | None:
    """By `settings.loop`; None if there is nothing to be found.

    **Arguments:**
    - `driven`: the map as the drive left it.
    """
    if len(run_log.stamps) < 2:
        return None
    log = jax.tree.map(lambda *leaves: np.stack(leaves), *run_log.observations)
    path = smoothing.Path(
        run_log.T_world_robot, jnp.asarray(np.stack(run_log.tilt)), jnp.asarray(run_log.bias)
    )
    _make_room()
    way = {"paper": _by_the_paper, "smooth": _smooth}[settings.loop]
    begun = time.perf_counter()
    closed = way(drive, settings, run_log, log, path, state, driven)
    if closed is None or not np.isfinite(closed.trajectory.xy).all():
        return None
    closed = _in_the_frame_of(np.array(run_log.poses, float)[:, :2], closed)
    closed.report["seconds"] = time.perf_counter() - begun
    return closed


def _make_room() -> None:
    """What the drive was compiled with goes: else compiling the solution tops it by a third."""
    jax.clear_caches()
    gc.collect()
    if sys.platform == "linux":  # freed, but kept by the C library
        getattr(ctypes.CDLL(None), "malloc_trim", lambda pad: 0)(0)


def _in_the_frame_of(driven: np.ndarray, closed: Closed) -> Closed:
    """Moved so that its path [T, 2] lies nearest to the one known while driving.

    No image says where the world's axes are; so the map serves both paths.
    """
    if np.sqrt(driven.var(axis=0).sum()) < SPREAD:
        return closed
    path = closed.trajectory
    motion = align(path.xy, driven)
    return Closed(
        Trajectory(path.stamps, motion.apply(path.xy), path.yaw + motion.yaw),
        eqx.tree_at(
            lambda f: f.endpoints_world, closed.final, motion.apply(closed.final.endpoints_world)
        ),
        motion.apply(closed.places),
        motion.R @ closed.covariances @ motion.R.T,
        closed.report,
    )


def _smooth(drive, settings, run_log, log, path, state, _) -> Closed:
    """All poses and lines at once, and again with each loop that was found."""
    file = drive.camera_file
    closed = loop_closure.close(
        settings.slam, file.camera, file.mount, log, path, state.segment_map
    )
    done, final, asked = closed.smoothed, closed.final, closed.asked
    solution, T, n = done.solution, done.T_world_robot, len(done.index)
    bias = zip(
        ("distance", "left", "right", "curvature"), solution.unknowns.shared[4:], strict=True
    )
    end = np.sqrt(np.diag(solution.pose_covariance[n - 1])[:3])
    return Closed(
        Trajectory(np.array(run_log.stamps), np.asarray(T.xy), np.unwrap(T.yaw)),
        final,
        solution.unknowns.pose[:n, :2],
        solution.pose_covariance[:n, :2, :2],
        _revisits_report(asked, run_log)
        | {
            "keyframes": n,
            "lines": int(done.lines.valid.sum()),
            "off_floor": int((done.lines.valid & done.lines.off_floor).sum()),
            "merged": done.merged,
            "segments": int(done.problem.keyframes.known.sum()),
            "cost": [{"before": before, "after": after} for before, after in done.costs],
            "converged": bool(solution.converged),
            "pixel_sigma": float(done.problem.priors.pixel_sigma),
            "odometer": {name: float(value) for name, value in bias},
            "end_sigma": dict(zip(("x_m", "y_m", "yaw_rad"), end.tolist(), strict=True)),
        },
    )


def _by_the_paper(drive, _settings, run_log, _log, path, state, final) -> Closed:
    """The error at the end, spread evenly back along the path; as it was if no loop is found."""
    mount = drive.camera_file.mount
    known = loop_closure.driven(path, mount, state.segment_map, final)
    last = np.array([len(run_log.stamps) - 1])
    asked = loop_closure.revisits(TOLD, known, last)
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
        _revisits_report(asked, run_log) | {"lines": int(state.segment_map.valid.sum())},
    )


def _revisits_report(asked: list[loop_closure.Revisit], run_log: RunLog) -> dict[str, object]:
    """Every place that was asked for, and why a loop was closed there or refused."""
    rows = []
    for revisit in asked:
        c = revisit.closing
        here = jnp.asarray(run_log.poses[revisit.image][:2], float)
        shift = np.hypot(*(c.T_correction.apply(here) - here))
        row = {"at": run_log.stamps[revisit.image], "since": run_log.stamps[revisit.since]}
        row |= {"accepted": c.accepted, "why": c.reason or "one place fits, and no other near it"}
        row |= {"lines": c.lines, "matched": c.matched, "lead": c.lead}
        rows.append(row | ({"shift_m": float(shift)} if c.accepted else {}))
    accepted = sum(row["accepted"] for row in rows)
    return {
        "found": len(rows),
        "accepted": accepted,
        "refused": len(rows) - accepted,
        "loops": rows,
    }
