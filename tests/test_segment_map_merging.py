"""Duplicate lines are merged, and what was seen seldom is forgotten."""

import dataclasses

import numpy as np
import pytest
from test_segment_map import (
    GAMMA,
    KALMAN,
    across,
    assert_bitwise_equal,
    doubled,
    ends_of,
    see,
    seen,
)

from sofjax.segment_map import (
    empty_map,
)

pytestmark = pytest.mark.usefixtures("x64")


@pytest.mark.parametrize("rules", [GAMMA, KALMAN], ids=["gamma", "kalman"])
def test_a_doubled_line_joins_the_older_one(rules):
    m, ends = doubled(rules)
    merged = seen(m, ends, slots=[1], rules=rules)
    np.testing.assert_array_equal(merged.valid[:2], [True, False])
    np.testing.assert_allclose(ends_of(merged), across(1.0, 0, 3), atol=1e-6)
    assert merged.updates[0] == 3


@pytest.mark.parametrize(
    "second",
    [{"y": 1.02}, {"x0": 2.4, "x1": 3.5}],
    ids=["farther than merge_distance", "a gap wider than join_gap"],
)
def test_lines_apart_stay_two(second):
    m, ends = doubled(**second)
    assert seen(m, ends, slots=[1]).valid.sum() == 2


def test_lines_that_cross_stay_two():
    m = seen(empty_map(GAMMA), across(1.0, -0.05, 0.05))
    for _ in range(2):
        m = seen(m, across(1.0, -0.05, 0.05), slots=[0])
    crossing = [[-0.05, 0.995], [0.05, 1.005]]  # within a centimetre, but turned by 0.1
    m = seen(seen(m, crossing), crossing, slots=[1])
    assert m.valid.sum() == 2


def test_the_older_line_does_not_join_the_younger():
    m, _ = doubled()
    merged = seen(m, across(1.0), slots=[0])
    assert merged.valid.sum() == 2  # until the younger is seen again


def test_a_line_that_dies_takes_no_other_with_it():
    """Three near lines, the second and third seen: each joins the first, none is lost."""
    m, ends = doubled()
    m = seen(m, across(0.997, 2.9, 4.0))
    merged = seen(m, ends, across(0.997, 2.9, 4.0), slots=[1, 2])
    m2 = seen(merged, across(0.997, 2.9, 4.0), slots=[2]) if merged.valid[2] else merged
    np.testing.assert_array_equal(m2.valid[:3], [True, False, False])
    np.testing.assert_allclose(ends_of(m2)[:, 0], [0, 4], atol=1e-6)


def test_what_was_seen_a_few_times_long_ago_is_forgotten():
    rules = dataclasses.replace(GAMMA, forget=2, min_updates=3)
    m = seen(empty_map(rules), across(1.0), across(-1.0), rules=rules)
    for _ in range(2):
        m = seen(m, across(1.0), slots=[0], rules=rules)
    np.testing.assert_array_equal(m.unseen[:2], [0, 2])
    m = seen(m, across(3.0), rules=rules)
    np.testing.assert_array_equal(m.valid[:3], [True, False, True])  # the third seen three times
    for _ in range(5):
        m = seen(m, across(3.0), slots=[2], rules=rules)
    assert m.valid[0] and m.unseen[0] == 6  # seen often enough to stay


def test_a_line_in_view_that_is_not_seen_is_counted_as_expected():
    m = seen(empty_map(GAMMA), across(1.0), across(-1.0), across(2.0))
    m = seen(m, across(1.0), slots=[0], view=[1, 5])
    np.testing.assert_array_equal(m.expected[:3], [2, 2, 1])
    assert m.expected[5] == 0  # no line there


@pytest.mark.parametrize("rules", [GAMMA, KALMAN], ids=["gamma", "kalman"])
def test_an_image_without_segments_leaves_the_map_bit_identical(rules):
    rules = dataclasses.replace(rules, length=1.5, forget=0)
    m = seen(empty_map(rules), across(1.0), across(-1.0), rules=rules)
    m = seen(m, across(1.01, 0, 3), slots=[0], rules=dataclasses.replace(rules, length=2.5))
    assert m.resting[0] > 0 and m.unseen[1] > 0
    m, _ = see(m, across(1.01, 0, 3), slots=[0], rules=rules)
    for _ in range(3):
        after, overflow = see(m, rules=rules, view=[0, 1])
        assert overflow == 0
        assert_bitwise_equal(after, m)
