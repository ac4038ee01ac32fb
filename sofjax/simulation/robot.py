"""A robot that is steered by hand along waypoints, and its odometer with errors."""

import itertools
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sofjax.geometry.se2 import SE2
from sofjax.io.trajectory import Trajectory
from sofjax.simulation.world.plan import distance_to_path

STEP = 0.02  # seconds between the poses of a driven path


@dataclass(frozen=True)
class Driver:
    """How a robot with two driven wheels is steered by hand."""

    speed: float = 0.7  # metres per second on a straight
    turn_rate: float = 0.8  # radians per second at most
    acceleration: float = 0.5  # metres per second squared
    jitter: float = 0.05  # radians per second, of the hand that steers
    look_ahead: float = 0.8  # metres, from the robot to the point of the path it steers at


def drive_along(
    waypoints: Float[np.ndarray, "points 2"], driver: Driver, rng: np.random.Generator
) -> Trajectory:
    """Drive along waypoints: slower in bends, turning on the spot where the path turns back.

    **Returns:** true poses every `STEP` seconds from 0, from rest to rest.
    """
    at, yaw, hand = waypoints[0].astype(float), _heading(waypoints[1] - waypoints[0]), 0.0
    poses = [(*at, yaw)]
    for section in _sections(waypoints):
        arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(section, axis=0), axis=1)))
        speed = turn = progress = 0.0
        give_up = len(poses) + int((60 + 10 * arc[-1] / driver.speed) / STEP)
        while progress < arc[-1] - 0.05 and len(poses) < give_up:
            progress = _advance(section, arc, at, progress)
            rest = arc[-1] - progress
            error = _heading(_point(section, arc, progress + driver.look_ahead) - at) - yaw
            error = (error + np.pi) % (2 * np.pi) - np.pi
            hand += (
                -hand * STEP / 1.5 + driver.jitter * np.sqrt(STEP / 0.75) * rng.standard_normal()
            )
            wanted_turn = np.clip(1.8 * error, -driver.turn_rate, driver.turn_rate) + hand
            braking = np.sqrt(driver.acceleration * (rest + 0.02))
            wanted = min(driver.speed * max(0.0, np.cos(1.5 * min(abs(error), 1.0))) ** 2, braking)
            change = driver.acceleration * STEP
            speed += np.clip(wanted - speed, -2 * change, change)
            turn += np.clip(wanted_turn - turn, -3.0 * STEP, 3.0 * STEP)
            middle = yaw + turn * STEP / 2
            at = at + speed * STEP * np.array([np.cos(middle), np.sin(middle)])
            yaw += turn * STEP
            poses.append((*at, yaw))
    x, y, yaws = np.array(poses).T
    return Trajectory(STEP * np.arange(len(poses)), np.stack([x, y], axis=-1), yaws)


def _heading(vector: np.ndarray) -> float:
    return float(np.arctan2(vector[1], vector[0]))


def _sections(waypoints: np.ndarray) -> list[np.ndarray]:
    """Waypoints, cut where the path turns back by more than 120 degrees."""
    d = np.diff(waypoints, axis=0)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    backs = np.flatnonzero((d[1:] * d[:-1]).sum(1) < -0.5) + 1
    ends = [0, *backs, len(waypoints) - 1]
    return [waypoints[a : b + 1] for a, b in itertools.pairwise(ends)]


def _point(waypoints: np.ndarray, arc: np.ndarray, s: float) -> np.ndarray:
    """The point at arc length `s`, on the prolonged last leg beyond the end."""
    i = min(int(np.searchsorted(arc, s, side="right")) - 1, len(waypoints) - 2)
    return waypoints[i] + (s - arc[i]) / (arc[i + 1] - arc[i]) * (waypoints[i + 1] - waypoints[i])


def _advance(waypoints: np.ndarray, arc: np.ndarray, at: np.ndarray, progress: float) -> float:
    """How far along the path the robot is, metres: never back, and never more than a step ahead."""
    ahead = np.linspace(progress, min(progress + 0.1, arc[-1]), 11)
    x, y = np.interp(ahead, arc, waypoints[:, 0]), np.interp(ahead, arc, waypoints[:, 1])
    return float(ahead[((x - at[0]) ** 2 + (y - at[1]) ** 2).argmin()])


def _number(default: float) -> Any:
    return eqx.field(converter=lambda value: jnp.asarray(value, float), default=default)


class Odometer(eqx.Module):
    """What wheels report: wrong scales, a drift to one side, noise and slip.

    The defaults are those of the paper's robot: fair on straights, and corners to the right
    read as more than they were, so that the path spins inward.
    """

    distance: Float[Array, "*batch"] = _number(1.01)  # read / true
    left: Float[Array, "*batch"] = _number(1.02)  # read / true
    right: Float[Array, "*batch"] = _number(1.07)  # read / true
    bend: Float[Array, "*batch"] = _number(0.0)  # radians per metre driven
    distance_noise: Float[Array, "*batch"] = _number(0.004)  # metres per sqrt(metre)
    heading_noise: Float[Array, "*batch"] = _number(0.003)  # radians per sqrt(metre)
    turn_noise: Float[Array, "*batch"] = _number(0.01)  # radians per sqrt(radian)
    slip: Float[Array, "*batch"] = _number(0.02)  # slips per metre

    @jax.jit
    def read(self, motions: SE2, key: PRNGKeyArray) -> SE2:
        """The readings of motions; their noise adds up to the same however the path is divided.

        **Arguments:**
        - `motions`: T_previous_current, true, with one axis T in front.

        **Returns:** T_previous_current as read.
        """
        forward, sideways, turn = jnp.moveaxis(motions.log(), -1, 0)
        noise_key, slip_key, wheel_key = jax.random.split(key, 3)
        distance_draw, heading_draw, turn_draw = jax.random.normal(noise_key, (3, *turn.shape))
        distance = jnp.abs(forward)
        read_forward = (
            forward * self.distance + self.distance_noise * jnp.sqrt(distance) * distance_draw
        )
        read_turn = (
            turn * jnp.where(turn > 0, self.left, self.right)
            + self.bend * forward
            + self.heading_noise * jnp.sqrt(distance) * heading_draw
            + self.turn_noise * jnp.sqrt(jnp.abs(turn)) * turn_draw
        )
        # A slip: one wheel spins on, the robot does not follow.
        slips = jax.random.uniform(slip_key, turn.shape) < self.slip * distance
        spun = jnp.where(slips, SLIP * jax.random.normal(wheel_key, turn.shape), 0)
        read_forward = read_forward + jnp.abs(spun) / 2
        return SE2.exp(jnp.stack([read_forward, sideways, read_turn + spun / TRACK], axis=-1))


SLIP = 0.01  # metres that a wheel spins in a slip
TRACK = 0.4  # metres between the wheels


def increments(trajectory: Trajectory) -> SE2:
    """T_previous_current between the poses of a path; the identity at the first."""
    return _between_poses(SE2(jnp.asarray(trajectory.xy), jnp.asarray(trajectory.yaw)))


@jax.jit
def _between_poses(poses: SE2) -> SE2:
    before = jax.tree.map(lambda leaf: jnp.concatenate([leaf[:1], leaf[:-1]]), poses)
    return before.between(poses)


def read_path(odometer: Odometer, truth: Trajectory, key: PRNGKeyArray) -> Trajectory:
    """The path that an odometer reports, from the origin of its own frame."""
    read = odometer.read(increments(truth), key)
    steps, turns = np.asarray(read.xy, float), np.asarray(read.yaw, float)
    yaw = np.cumsum(turns)
    before = yaw - turns
    c, s = np.cos(before), np.sin(before)
    xy = np.cumsum(
        np.stack([c * steps[:, 0] - s * steps[:, 1], s * steps[:, 0] + c * steps[:, 1]], -1), 0
    )
    return Trajectory(truth.stamps, xy, yaw)


def clearance(walls: Float[np.ndarray, "walls 2 2"], truth: Trajectory) -> float:
    """Smallest distance of a path from the walls, metres."""
    return float(min(distance_to_path(wall, truth.xy).min() for wall in walls))
