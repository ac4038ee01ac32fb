"""Which pairs of lines are one is told by all of them together."""

import numpy as np
import pytest

from sofjax.smoothing.association.joint_compatibility import GATE, compatible

OWN = 0.005  # metres, radians: of each pair, besides what all share


def drifted(across, drift_sigma=0.05):
    """Pairs that lie `across` of each other where one drift across is shared by all."""
    n = len(across)
    d = np.zeros((n, 3))
    d[:, 0] = across
    S = np.zeros((n, 3, n, 3))
    S[:, 0, :, 0] = drift_sigma**2
    S[np.arange(n), :, np.arange(n)] += OWN**2 * np.eye(3)
    return d, S


def among(n, *excluding):
    rivals = np.zeros((n, n), bool)
    for a, b in excluding:
        rivals[a, b] = rivals[b, a] = True
    return rivals


def test_what_fits_alone_is_refused_where_all_else_has_drifted():
    d, S = drifted([0.081, 0.001, 0.078, 0.083, 0.08])  # the second: a baseboard's edges, 8 cm
    assert set(compatible(d, S, among(5))) == {0, 2, 3, 4}
    assert compatible(d[1:2], S[1:2, :, 1:2], among(1)) == [0]


@pytest.mark.parametrize(
    ("across", "chosen"),
    [
        ([0.0, 0.1, 0.001, 0.099], set()),  # two for each: as well the one as the other
        ([0.0, 0.1, 0.001, 0.099, 0.002, 0.003], {0, 2, 4, 5}),
    ],
)
def test_as_well_one_place_as_another_is_left_undecided(across, chosen):
    d, S = drifted(across)
    assert set(compatible(d, S, among(len(across)))) == chosen


def test_a_drift_at_the_gate_takes_along_what_is_beyond_it():
    d, S = drifted([0.148, 0.153, 0.155, 0.16, 0.0])  # the last fits best alone
    assert set(compatible(d, S, among(5))) == {0, 1, 2, 3}
    for one in range(1, 4):
        assert compatible(d[[one]], S[[one]][:, :, [one]], among(1)) == []


def test_where_all_is_beyond_the_gate_nothing_is_chosen_and_nothing_against_it():
    d, S = drifted([0.17, 0.169, 0.172, 0.17, 0.0])
    assert compatible(d, S, among(5)) == []
    assert compatible(d[4:], S[4:, :, 4:], among(1)) == [0]


def test_what_is_beyond_the_gate_and_alone_excludes_nothing():
    d, S = drifted([0.0, 0.17], drift_sigma=0.05)
    S[0, :, 1], S[1, :, 0] = 0, 0
    assert compatible(d, S, among(2, (0, 1))) == [0]


def test_of_two_that_exclude_each_other_the_better_by_far_is_one():
    d, S = drifted([0.0, 0.0, 0.002, 0.029])
    assert set(compatible(d, S, among(4, (2, 3)))) == {0, 1, 2}  # the last is 4 sigma off
    d, S = drifted([0.0, 0.0, 0.002, 0.014])
    assert set(compatible(d, S, among(4, (2, 3)))) == {0, 1}  # within the gate, and as likely


def test_chosen_pairs_fit_by_dense_conditioning_on_those_before(rng):
    n, rounds, found = 8, 20, 0
    for _ in range(rounds):
        shared = rng.normal(size=(n, 3, 4))
        S = np.einsum("pik,qjk->piqj", shared, shared)
        S[np.arange(n), :, np.arange(n)] += 0.1 * np.eye(3)
        d = np.einsum("pik,k->pi", shared, rng.normal(size=4)) + 0.3 * rng.normal(size=(n, 3))
        d[rng.integers(n)] += rng.normal(size=3) * 3
        chosen = compatible(d, S, among(n))
        for m, k in enumerate(chosen):
            before = chosen[:m]
            own, cross = S[k, :, k], S[k][:, before].reshape(3, -1)
            if m:
                C = S[before][:, :, before].reshape(3 * m, 3 * m)
                e = d[k] - cross @ np.linalg.solve(C, d[before].ravel())
                own = own - cross @ np.linalg.solve(C, cross.T)
            else:
                e = d[k]
            assert e @ np.linalg.solve(own, e) < GATE**2
        assert len(set(chosen)) == len(chosen)
        found += len(chosen)
    assert found > 0.9 * rounds * (n - 1)  # all but the one that was moved


def test_of_none_none_is_chosen():
    d, S = drifted([])
    assert compatible(d, S, among(0)) == []
    d, S = drifted([1.0])  # twenty standard deviations
    assert compatible(d, S, among(1)) == []


def test_one_a_little_beyond_the_gate_keeps_no_others_back():
    rng = np.random.default_rng(3)
    d, S = drifted(0.06 + rng.normal(0, 0.3 * OWN, size=40))
    d[7] = 0.06, 3.3 * OWN, 0.0  # of a hundred some are; all bear it out, and none has it
    assert set(compatible(d, S, among(40))) >= set(range(40)) - {7}
