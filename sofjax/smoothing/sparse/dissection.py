"""Which unknowns of a drive are eliminated with which others: nested dissection.

The keyframes are divided by place into leaves, and the leaves are gathered by fours, and so on, to
a tree. A pose is known to its own leaf and to that of the next keyframe, a line to the leaves that
see it. Each unknown is eliminated at the node under which all the leaves lie that know it: most at
a leaf, few above it, whether a place is passed once or many times. George, Nested dissection of a
regular finite element mesh (1973); Davis, Direct Methods for Sparse Linear Systems (2006).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sofjax.smoothing.problem import LINE, POSE, SHARED, Keyframes

BRANCH = 4  # nodes that are gathered to one
LEAF = 48  # keyframes of a leaf at most
SHORT, LEAF_OF_SHORT = 1024, 128  # short drives compile longer than they compute: a lower tree
ROUND = 16  # sizes of a node's tables are multiples of it
SLACK = 1.15  # better poses show more lines: headroom against recompilation


class Generation(eqx.Module):
    """N nodes of one height. Of each the a unknowns that it eliminates, and the q others that these
    are tied to, which its ancestors eliminate: its border.
    """

    own: Int[Array, "N a"]  # places among all U unknowns; U: none
    border: Int[Array, "N q"]  # the same
    above: Int[Array, "N q"]  # where its parent has the border among (own, border); a' + q': none


class Leaves(eqx.Module):
    """C leaves and what each of them brings in, with the places of that among its (own, border)."""

    frame: Int[Array, "C c"]  # keyframes; n: none
    here: Int[Array, "C c"]  # of the first unknown of a keyframe's pose, and so on; a + q: none
    before: Int[Array, "C c"]  # of the pose before it
    measurement: Int[Array, "C s"]  # segments that show a line, counted through [n, M]; n M: none
    by_pose: Int[Array, "C s"]  # places of the pose and of the line that each of them ties
    by_line: Int[Array, "C s"]
    line: Int[Array, "C P"]  # lines that are brought in here and by no other leaf; K: none
    line_at: Int[Array, "C P"]
    shared: Int[Array, "C"]  # of what the whole drive shares


class Dissection(eqx.Module):
    leaves: Leaves
    generations: tuple[Generation, ...]  # from the leaves to the root
    pose: tuple[Int[Array, "n"], Int[Array, "n"]]  # the leaf of each keyframe, and its place there
    line: tuple[Int[Array, "K"], Int[Array, "K"]]  # the leaf that brings it in, and its place there

    @property
    def size(self) -> int:
        """U, the number of all unknowns."""
        return POSE * self.pose[0].shape[0] + LINE * self.line[0].shape[0] + SHARED


def divide(xy: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n"]:
    """Leaves of keyframes by place: halved across the longer side, again and again."""
    groups = [np.arange(len(xy))]
    most = LEAF if len(xy) > SHORT else LEAF_OF_SHORT
    while len(groups[0]) > most:
        for _ in range(BRANCH.bit_length() - 1):
            halves = []
            for group in groups:
                across = np.ptp(xy[group], axis=0).argmax() if len(group) else 0
                order = group[np.argsort(xy[group, across], kind="stable")]
                halves += [order[: len(order) // 2], order[len(order) // 2 :]]
            groups = halves
    leaf = np.zeros(len(xy), int)
    for i, group in enumerate(groups):
        leaf[group] = i
    return leaf


def dissect(
    keyframes: Keyframes, K: int, leaf: Int[np.ndarray, "n"], before: Dissection | None = None
) -> Dissection:
    """By what the keyframes [n] see now; on the host.

    **Arguments:**
    - `K`: the number of lines.
    - `leaf`: of each keyframe, of `divide`.
    - `before`: another of these keyframes; with no less room than in that, what was compiled for
      it serves again.
    """
    line = np.where(np.asarray(keyframes.known), np.asarray(keyframes.line), K)
    n, height = len(line), _height(int(leaf.max()))
    # variables are poses, lines and what all share, of so many unknowns each
    size = np.repeat([POSE, LINE, SHARED], [n, K, 1])
    first = np.cumsum(size) - size
    known = _known(leaf, line, K, BRANCH**height)
    end = _ends(known, height)
    generations: list[Generation] = []
    inside: list[np.ndarray] = [known]
    above = np.zeros((0, 0), int)
    for _ in range(height):
        inside.append(np.asarray(inside[-1].reshape(-1, BRANCH, len(size)).any(axis=1)))
    for h in reversed(range(height + 1)):
        own = [np.flatnonzero(node & (end == h)) for node in inside[h]]
        border = [np.flatnonzero(node & (end > h)) for node in inside[h]]
        was = None if before is None else before.generations[h]
        a = _room([int(size[v].sum()) for v in own], was and was.own)
        q = _room([int(size[v].sum()) for v in border], was and was.border)
        place = np.full((len(own), len(size) + 1), a + q)  # the last is that of none
        for row, mine, others in zip(place, own, border, strict=True):
            row[mine] = np.cumsum(size[mine]) - size[mine]
            row[others] = a + np.cumsum(size[others]) - size[others]
        parents = above if len(above) else np.zeros((1, len(size) + 1), int)
        in_parent = np.repeat(parents, BRANCH, axis=0)[: len(own)]
        rows = lambda variables, starts, width, none: jnp.asarray(np.stack([
            _filled(_unknowns(start[v], size[v]), width, none)
            for v, start in zip(variables, starts, strict=True)
        ]))  # fmt: skip
        everywhere = [first] * len(own)
        generations.insert(0, Generation(
            rows(own, everywhere, a, size.sum()), rows(border, everywhere, q, size.sum()),
            rows(border, in_parent, q, parents.max()),
        ))  # fmt: skip
        above = place
    home = known[:, n : n + K].argmax(axis=0)
    leaves = _leaves(leaf, line, home, above, before and before.leaves)
    poses = leaf, above[leaf, np.arange(n)]
    lines = home, above[home, n + np.arange(K)]
    return Dissection(leaves, tuple(generations), *jax.tree.map(jnp.asarray, (poses, lines)))


def _known(leaf: np.ndarray, line: np.ndarray, K: int, C: int) -> Bool[np.ndarray, "C variables"]:
    """Which variables each leaf knows; of a line that nobody sees some leaf must."""
    n = len(leaf)
    known = np.zeros((C, n + K + 1), bool)
    known[leaf, np.arange(n)] = True
    known[leaf[1:], np.arange(n - 1)] = True
    known[np.repeat(leaf, line.shape[1]), n + line.ravel()] = True
    unseen = np.flatnonzero(~known[:, n : n + K].any(axis=0))
    known[unseen % C, n + unseen] = True
    known[:, -1] = True
    return known


def _ends(known: np.ndarray, height: int) -> Int[np.ndarray, "variables"]:
    """The height of the lowest node above all leaves that know a variable; of what all share, that
    of the root.
    """
    low, high = known.argmax(axis=0), len(known) - 1 - known[::-1].argmax(axis=0)
    end = np.zeros(len(low), int)
    for h in range(height):
        end[low // BRANCH**h != high // BRANCH**h] = h + 1
    end[-1] = height
    return end


def _leaves(
    leaf: np.ndarray, line: np.ndarray, home: np.ndarray, place: np.ndarray, before: Leaves | None
) -> Leaves:
    """The leaves; `place` [C, variables + 1] is in each of them, the last that of none."""
    (n, M), K, C = line.shape, len(home), len(place)
    of_leaf = np.arange(C)[:, None]
    table = lambda rows, width, none: np.stack([_filled(row, width, none) for row in rows])
    frames = [np.flatnonzero(leaf == i) for i in range(C)]
    frame = table(frames, max(map(len, frames)), n)
    brought = [np.flatnonzero(home == i) for i in range(C)]
    brought = table(brought, _room([len(b) for b in brought], before and before.line), K)
    shown = [np.flatnonzero((leaf == i)[:, None] & (line < K)) for i in range(C)]
    room = _room([len(s) for s in shown], before and before.measurement, slack=1.5)
    measurement = table(shown, room, n * M)
    pose = lambda i: place[of_leaf, np.where((i >= 0) & (i < n), i, n + K + 1)]
    to_line = lambda k: place[of_leaf, np.where(k < K, n + k, n + K + 1)]
    return Leaves(*map(jnp.asarray, (
        frame, pose(frame), pose(np.where(frame < n, frame - 1, n)),
        measurement, pose(measurement // M), to_line(np.append(line, K)[measurement]),
        brought, to_line(brought), place[:, n + K],
    )))  # fmt: skip


def _height(last: int) -> int:
    height = 0
    while BRANCH**height <= last:
        height += 1
    return height


def _room(sizes: list[int], before: Array | None, slack: float = SLACK) -> int:
    """Columns of a table: as many as it had before, if they suffice."""
    most, least = max(sizes), 0 if before is None else before.shape[1]
    return least if most <= least else ROUND * -(-int(slack * most) // ROUND)


def _unknowns(start: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Consecutive places from each start."""
    within = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
    return np.repeat(start, size) + within


def _filled(row: np.ndarray, width: int, none: int | np.integer) -> np.ndarray:
    return np.append(row, np.full(width - len(row), none))
