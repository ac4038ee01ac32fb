"""A whole drive smoothed, and smoothed again with each loop that is found in it."""

import dataclasses
import math

import equinox as eqx
import jax

from sofjax._pytree import float_of
from sofjax.extraction.observation import Observation
from sofjax.geometry.camera import Camera, Mount
from sofjax.loop_closure.place_recognition import ClosingConfig
from sofjax.loop_closure.revisits import Revisit, closed, joined_map, revisits, solved
from sofjax.segment_map import FinalMap, SegmentMap
from sofjax.slam.config import SlamConfig
from sofjax.smoothing import Path, Smoothed, SmoothingConfig, final_map, smooth

DEFAULT, CLOSING = SmoothingConfig(), ClosingConfig()
SOLUTIONS = 4  # at most: one more after each loop that is closed


class ClosedDrive(eqx.Module):
    """The last solution, its map, and every place that was asked for."""

    smoothed: Smoothed
    final: FinalMap
    asked: list[Revisit]  # images of them by the drive as it was then


def close(
    config: SlamConfig,
    camera: Camera,
    mount: Mount,
    log: Observation,
    path: Path,
    segment_map: SegmentMap,
    rules: SmoothingConfig = DEFAULT,
    closing: ClosingConfig = CLOSING,
) -> ClosedDrive:
    """Smooth, look for a place seen again, join the lines that are one there, and smooth again.

    Arguments are those of `smoothing.smooth`.
    """
    asked = []
    config = jax.tree.map(float_of, config.in_metres(camera, mount))  # for either precision
    for _ in range(SOLUTIONS):
        done = smooth(config, camera, mount, log, path, segment_map, rules)
        final = final_map(config.segment_map, done)
        known = solved(done, final)
        now = revisits(closing, known)
        accepted = [revisit for revisit in now if revisit.closing.accepted]
        asked += accepted[:1] or now
        if not accepted:
            break
        T_world_robot, motion = closed(known, accepted[0])
        segment_map = joined_map(done, known, motion, accepted[0])
        path = Path(T_world_robot, path.tilt, path.bias)
        rules = dataclasses.replace(rules, passing=math.inf)  # what was joined is one line
    return ClosedDrive(done, final, asked)
