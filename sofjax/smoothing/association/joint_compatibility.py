"""Which of many differences may all be zero at once, and which pairs of lines are therefore one.

Joint compatibility (Neira and Tardos, IEEE T-RO 17(6), 2001): after a long way the drift may
be as large as the gap between two edges, such as bottom and top of a baseboard, and each then fits
the other alone. All pairs of a place share one drift, so they are tested jointly.
"""

import numpy as np
from jaxtyping import Bool, Float

GATE = 3.0  # standard deviations of a difference
WIDE = 4.0  # beyond this it is excluded; once others are one it may be within the gate


def compatible(
    d: Float[np.ndarray, "pairs 3"],
    S: Float[np.ndarray, "pairs 3 pairs 3"],
    rivals: Bool[np.ndarray, "pairs pairs"],
) -> list[int]:
    """Pairs that are one, chosen in turn: the one that all pairs that are left support best.

    A pair supports another by as much as its being one makes the other's difference likelier. A
    pair stays undecided while a pair that excludes it is supported as well. A pair beyond the gate
    is not chosen, but it counts: once others are one it may be within the gate.

    **Arguments:**
    - `d`: differences of the two of each pair.
    - `S`: the covariance of all of them together; each has some error of its own.
    - `rivals`: pairs of which not both can be one.

    **Returns:** the pairs, in the order in which they were chosen.
    """
    chosen, index = [], np.arange(len(d))
    while True:
        e = _squared(d, _own(S))
        possible = e < WIDE**2
        index, d, S, e = index[possible], d[possible], S[possible][:, :, possible], e[possible]
        rivals = rivals[possible][:, possible]
        if not len(index):
            return chosen
        support, excludes = _support(d, S, rivals)
        none = _of_rivals(np.maximum(GATE**2 - e, 0)[None], rivals)  # if no more are one
        within = e < GATE**2
        supported = within | (support > none + GATE**2)
        other = np.where(excludes & supported, support, -np.inf).max(axis=1)
        clear = within & (support > other + GATE**2)
        if not clear.any():
            return chosen
        k = np.where(clear, support, -np.inf).argmax()
        chosen.append(int(index[k]))
        keep = ~rivals[k]
        keep[k] = False
        gain = np.linalg.solve(S[k, :, k], S[k].reshape(3, -1))
        d = d - (d[k] @ gain).reshape(d.shape)
        S = S - (S[k].reshape(3, -1).T @ gain).reshape(S.shape)
        index, d, S, rivals = index[keep], d[keep], S[keep][:, :, keep], rivals[keep][:, keep]


def _own(S: np.ndarray) -> np.ndarray:
    """[p, 3, 3] Each pair's own covariance."""
    n = np.arange(len(S))
    return S[n, :, n]


def _squared(d: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distances."""
    return np.einsum("...i,...i->...", d, np.linalg.solve(own, d[..., None])[..., 0])


def _support(d: np.ndarray, S: np.ndarray, rivals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The support of each pair [h], and the pairs [h, p] that it excludes.

    The support is twice the log-likelihood that the pair adds if it is one: its own, and that of
    all pairs that it makes likelier; a pair at the gate adds nothing. It excludes its rivals, and
    what is then beyond WIDE.
    """
    own, itself = _own(S), np.eye(len(d), dtype=bool)
    gain = np.einsum("hij,hjqk->hiqk", np.linalg.inv(own), S)
    d_given = d - np.einsum("hi,hiqk->hqk", d, gain)
    S_given = own - np.einsum("hiqj,hiqk->hqjk", S, gain)
    S_given[itself] = own
    e = np.where(itself, _squared(d, own), _squared(d_given, S_given))
    narrowed = np.linalg.slogdet(own)[1] - np.linalg.slogdet(S_given)[1]
    excludes = rivals | (e > WIDE**2)  # of hundreds of true pairs some are beyond the gate
    value = np.where(excludes, 0, np.maximum(GATE**2 - e + narrowed, 0))
    return _of_rivals(value, rivals), excludes


def _of_rivals(value: np.ndarray, rivals: np.ndarray) -> np.ndarray:
    """The sum of the values [h, pairs], of rivals the best one alone."""
    best = (value[:, :, None] >= value[:, None, :]) | ~rivals
    return np.where(best.all(axis=2), value, 0).sum(axis=1)
