"""Which segments a line keeps: split by revisit, merged, and dropped where they contradict it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from sofjax.smoothing import keyframes as kf
from sofjax.smoothing.association.lines import Lines
from sofjax.smoothing.problem import Keyframes, Problem, distances

BENT = 2.0  # times the pixels' standard deviation: root mean square that no one line has


def apart(
    problem: Problem, lines: Lines, passing: float, least: int, room: int
) -> tuple[Problem, Lines]:
    """Lines split by revisit: one that is seen again starts a new line until the two are merged.

    The drift may be as large as the gap between two edges, such as bottom and top of a baseboard.
    Each is then taken for the other, and so are all beside them: no solution leads back.

    **Arguments:**
    - `passing`: metres driven after which a revisit starts a new line until it is merged.
    - `least`: measurements that make a line; fewer are left out.
    - `room`: least size of what is compiled.
    """
    frames = problem.keyframes
    driven, known, name = map(np.array, (frames.driven, frames.known, frames.line))
    at = np.nonzero(known)
    order = np.lexsort((at[0], name[at]))
    at = at[0][order], at[1][order]
    old, way = name[at], driven[at[0]]
    is_first = np.diff(old, prepend=-1) != 0
    begins = is_first | (np.diff(way, prepend=0) > passing)
    parent, group, ends = old[begins], np.cumsum(begins) - 1, np.roll(begins, -1)
    enough = np.bincount(group, minlength=len(parent)) >= least
    more, own = enough & ~is_first[begins], enough | is_first[begins]

    count = int(lines.valid.sum())  # these come first
    new = np.where(more, count + np.cumsum(more) - 1, parent)
    total = count + int(more.sum())
    size = kf.padded(max(total, 1), room)
    source = np.zeros(size, int)
    source[:total] = np.append(np.arange(count), parent[more])
    span = np.tile([-np.inf, np.inf], (size, 1))
    span[new[own]] = np.stack([way[begins], way[ends]], axis=1)[own]
    span += passing / 2 * np.array([-1, 1])
    name[at], known[at] = new[group], enough[group]

    lines = jax.tree.map(lambda a: a[source], lines)
    lines = eqx.tree_at(
        lambda l: (l.off_floor, l.undetermined, l.valid, l.span),
        lines,
        (
            lines.off_floor | (np.arange(size) >= count),
            jnp.arange(size) >= count,
            jnp.arange(size) < total,
            jnp.asarray(span),
        ),
    )
    problem = eqx.tree_at(
        lambda p: (p.start.line, p.keyframes.line, p.keyframes.known),
        problem,
        (lines.line, jnp.asarray(name), jnp.asarray(known)),
    )
    return problem, lines


def renamed(problem: Problem, lines: Lines, name: Int[np.ndarray, "K"]) -> tuple[Problem, Lines]:
    """Merged lines: their segments show the one that remains, within the spans of all."""
    line, (first, last) = problem.keyframes.line, lines.span.T
    span = jnp.stack([first.at[name].min(first), last.at[name].max(last)], axis=1)
    valid = lines.valid & (name == np.arange(len(name)))
    lines = eqx.tree_at(lambda l: (l.valid, l.span), lines, (valid, span))
    line = jnp.asarray(name, line.dtype)[line]  # of the type that `_solve` was compiled for
    return eqx.tree_at(lambda p: p.keyframes.line, problem, line), lines


def without_bent(problem: Problem, lines: Lines) -> tuple[Problem, Lines, Bool[Array, ""]]:
    """Without lines whose residuals are far above the pixels' noise: no one line has shown those
    segments. And whether there were any.
    """
    frames, K = problem.keyframes, lines.valid.shape[0]
    count = measurements(frames, lines)
    square = (distances(problem.start, problem) ** 2).sum(axis=2)
    total = jnp.zeros(K).at[jnp.where(frames.known, frames.line, K)].add(square, mode="drop")
    variance = total / jnp.maximum(2 * count - 2, 1).astype(total.dtype)
    bent = lines.valid & (variance > (BENT * problem.priors.pixel_sigma) ** 2)
    problem = eqx.tree_at(lambda p: p.keyframes.known, problem, frames.known & ~bent[frames.line])
    lines = eqx.tree_at(lambda l: l.valid, lines, lines.valid & ~bent)
    return problem, lines, bent.any()


@jax.jit
def measurements(frames: Keyframes, lines: Lines) -> Int[Array, "K"]:
    """How many segments show each line."""
    K = lines.valid.shape[0]
    return jnp.zeros(K, int).at[jnp.where(frames.known, frames.line, K)].add(1, mode="drop")
