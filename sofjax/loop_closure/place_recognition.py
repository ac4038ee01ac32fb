"""A place seen again is found by its lines together: their angles and distances to each other.

Corridors repeat. What fits at one place fits nearly as well a block farther on, so a place is
trusted only if no other within reach of the uncertainty comes near it.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sofjax._checks import check_fields
from sofjax.geometry.angles import wrap_axial
from sofjax.geometry.lines import normal, polar_through
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import overlap


class ClosingConfig(eqx.Module):
    """When two sets of lines are one place."""

    sigma: float = 0.03  # metres between two descriptions of one line ...
    angle: float = 0.02  # ... and radians
    e_max: float = 9.0  # cost of a line that fits none
    reach: float = 4.0  # standard deviations that are searched
    step: float = 0.05  # metres between hypotheses ...
    turn: float = 0.01  # ... and radians
    most: int = eqx.field(static=True, default=20_000)  # hypotheses
    matched: int = 6  # lines that must fit, in two directions at least
    share: float = 0.7  # of the lines that should fit
    margin: float = 15.0  # log-likelihood by which the best place must lead all others ...
    apart: float = 0.3  # ... which are this far away, metres

    def __check_init__(self) -> None:
        check_fields(
            self,
            whole_from={"most": 1, "matched": 1},
            positive=("sigma", "angle", "e_max", "reach", "step", "turn"),
            at_least_zero=("share", "margin", "apart"),
        )


class Closing(eqx.Module):
    """One place looked for."""

    T_correction: SE2  # in the world, of what was seen later
    accepted: bool
    reason: str
    matched: int
    lines: int  # that were looked for
    lead: float  # log-likelihood before the next best place
    pairs: np.ndarray  # [P, 2] later line, earlier line


def hypotheses(
    config: ClosingConfig, sigma: Float[np.ndarray, "3"]
) -> tuple[np.ndarray, np.ndarray]:
    """Shifts and turns (x, y, yaw) [H, 3] that the standard deviations allow, and their spacing."""
    half = config.reach * np.asarray(sigma)
    step = np.array([config.step, config.step, config.turn])
    while np.prod(2 * np.ceil(half / step) + 1) > config.most:
        step = step * 1.15
    axes = [
        s * np.arange(-np.ceil(h / s), np.ceil(h / s) + 1) for h, s in zip(half, step, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), step


@jax.jit
def score(
    config: ClosingConfig,
    later: Float[Array, "L 2 2"],
    used: Bool[Array, "L"],
    earlier: Float[Array, "E 2 2"],
    there: Bool[Array, "E"],
    moves: Float[Array, "H 3"],
    slack: Float[Array, "3"],
) -> tuple[Float[Array, "H"], Array, Array]:
    """log L = -1/2 sum min(e, e_max) of each move of the later lines about their middle.

    **Arguments:**
    - `later`, `earlier`: end points about the middle of the later ones, metres.
    - `moves`: (x, y, yaw).
    - `slack`: what the hypotheses are apart, which widens the errors.

    **Returns:** the log-likelihoods; the earlier line nearest to each later one [H, L]; and whether
    it fits [H, L].
    """
    line = jax.vmap(polar_through)(earlier)
    n = normal(line)
    length = jnp.linalg.norm(later[:, 1] - later[:, 0], axis=1)
    across = config.sigma**2 + (slack[0] / 2) ** 2
    along = config.angle**2 + (slack[2] / 2) ** 2

    def of_move(move: Array) -> tuple[Array, ...]:
        moved = SE2(move[:2], move[2]).apply(later)
        middle = moved.mean(axis=1)
        theta = jax.vmap(polar_through)(moved).theta
        off = middle @ n.T - line.rho
        turn = wrap_axial(theta[:, None] - line.theta)
        e = off**2 / across + turn**2 / along
        shared = jax.vmap(jax.vmap(overlap, in_axes=(0, None)), in_axes=(None, 0))(earlier, moved)
        e = jnp.where(there & (shared > 0.3 * length[:, None]), e, jnp.inf)
        best = jnp.minimum(e.min(axis=1), config.e_max)
        return (
            -0.5 * jnp.sum(jnp.where(used, best, 0)),
            e.argmin(axis=1),
            used & (best < config.e_max),
        )

    return jax.lax.map(of_move, moves, batch_size=256)


def find(
    config: ClosingConfig,
    later: np.ndarray,
    earlier: np.ndarray,
    sigma: np.ndarray,
) -> Closing:
    """Where the later lines lie among the earlier ones, if that is one place and no other.

    **Arguments:**
    - `later`, `earlier`: [L, 2, 2] and [E, 2, 2] end points of lines on the floor, as both stand in
      the world now, metres.
    - `sigma`: standard deviations of the later ones against the earlier, (x, y, yaw).
    """
    none = lambda reason, matched=0, lead=0.0: Closing(
        SE2.identity(), False, reason, matched, len(later), lead, np.zeros((0, 2), int)
    )  # fmt: skip
    if len(later) < config.matched or len(earlier) < config.matched:
        return none("too few lines")
    middle = later.mean(axis=(0, 1))
    a, used = _pad(later - middle)
    b, there = _pad(earlier - middle)
    ask = lambda moves, step: [
        np.asarray(v)[: len(moves)]
        for v in score(config, a, used, b, there, _pad_rows(moves), jnp.asarray(step, a.dtype))
    ]
    moves, step = hypotheses(config, sigma)
    value, _, _ = ask(moves, step)

    def refined(move: np.ndarray) -> tuple[Any, ...]:
        """The best move about one, to a sixteenth of the spacing; and what `score` says of it."""
        for spacing in (step / 4, step / 16):
            ticks = [s * np.arange(-4, 5) for s in spacing]
            around = move + np.stack(np.meshgrid(*ticks, indexing="ij"), -1).reshape(-1, 3)
            scores = ask(around, spacing)
            top = scores[0].argmax()
            move = around[top]
        return move, *(a[top] for a in scores)

    best, value_best, nearest, fits = refined(moves[value.argmax()])
    matched = int(fits.sum())
    away = (np.hypot(*(moves[:, :2] - best[:2]).T) > config.apart) | (
        np.abs(moves[:, 2] - best[2]) > 0.1
    )
    rival = moves[away][value[away].argmax()] if away.any() else None
    lead = np.inf
    if rival is not None:
        lead = float(value_best - refined(rival)[1])
    angles = np.arctan2(*(later[:, 1] - later[:, 0]).T[::-1])[fits[: len(later)]]
    spread = 1 - np.abs(np.exp(2j * angles).mean()) if matched else 0.0
    if matched < config.matched or matched < config.share * len(later):
        return none("too few of the lines fit", matched, lead)
    if spread < 0.1:
        return none("all lines that fit run one way", matched, lead)
    if lead < config.margin:
        return none("another place fits nearly as well", matched, lead)
    if (np.abs(best[:2]) > 0.95 * config.reach * sigma[:2]).any():
        return none("at the edge of what was searched", matched, lead)
    about = SE2(jnp.asarray(middle), jnp.zeros(()))
    T = about @ SE2(jnp.asarray(best[:2]), jnp.asarray(best[2])) @ about.inverse()
    i = np.flatnonzero(fits[: len(later)])
    pairs = np.stack([i, nearest[i]], axis=1)
    return Closing(T, True, "", matched, len(later), lead, pairs)


def _pad(rows: np.ndarray, size: int = 64) -> tuple[Array, Array]:
    n = -(-len(rows) // size) * size
    padded = np.zeros((n, *rows.shape[1:]))
    padded[: len(rows)] = rows
    return jnp.asarray(padded), jnp.arange(n) < len(rows)


def _pad_rows(moves: np.ndarray) -> Array:
    return _pad(moves, 4096)[0]
