"""The one map of segments, rule by rule; III.B."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from conftest import jit_quickly

from sofjax.geometry import SE2, Segments
from sofjax.geometry.lines import polar_through
from sofjax.likelihood.measurements import Measurements
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.segment_map import (
    MapConfig,
    Observed,
    candidate_associations,
    empty_map,
    integrate,
)

pytestmark = pytest.mark.usefixtures("x64")

K, M = 8, 4
KALMAN = MapConfig(capacity=K, rho_drift=0.0, theta_drift=0.0)
GAMMA = dataclasses.replace(KALMAN, rule="gamma", classify=False)
STIFF = SensorModel(tilt_sigma=0.0)
grow, proposals = jit_quickly(integrate), jit_quickly(candidate_associations)


def everything(L):
    """Any line may be the same once more."""
    return jnp.broadcast_to(jnp.arange(L), (M, L))


def pose(x=0.0, y=0.0, yaw=0.0):
    return SE2(jnp.array([x, y], float), jnp.array(yaw, float))


def measurements_of(*ends, sigma=0.01):
    """Measurements in the nadir frame, padded to M; (rho, theta) with the same sigma each."""
    padded = np.zeros((M, 2, 2))
    padded[: len(ends)] = np.asarray(ends).reshape(-1, 2, 2)
    padded = jnp.asarray(padded)
    return Measurements(
        endpoints_nadir=padded,
        valid=jnp.arange(M) < len(ends),
        line=jax.vmap(polar_through)(padded),
        covariance=jnp.broadcast_to(sigma**2 * jnp.eye(2), (M, 2, 2)),
        by_jitter=jnp.zeros((M, 2, 2)),
    )


def see(segment_map, *ends, at=None, slots=None, rules=GAMMA, sigma=0.01, view=()):
    """The map after one image, of lines in `slots` or new ones; and how many found no place."""
    at = pose() if at is None else at
    known = jnp.arange(M) < len(slots or ())
    slot = jnp.array([*(slots or ()), *[0] * M], int)[:M]
    measurements = measurements_of(*ends, sigma=sigma)
    new = measurements.valid & ~known
    shown = jnp.zeros(K, bool).at[jnp.array(view, int)].set(True)
    return grow(
        rules, STIFF, segment_map,
        Observed(
            measurements, jnp.zeros(2), at, jnp.arange(K), shown, slot, known, everything(K), new
        ),
    )[:2]  # fmt: skip


def of_image(measurements, known, new, at=None, jitter=(0.0, 0.0)):
    """All measurements are of slot 0, and all of the map is near, and out of view."""
    where = pose() if at is None else at
    return Observed(
        measurements, jnp.array(jitter), where, jnp.arange(K), jnp.zeros(K, bool),
        jnp.zeros(M, int), known, everything(K), new,
    )  # fmt: skip


def seen(segment_map, *ends, **options):
    """The same, where every new line finds a place."""
    segment_map, overflow = see(segment_map, *ends, **options)
    assert overflow == 0
    return segment_map


def ends_of(segment_map, slot=0):
    return np.asarray(segment_map.segments_world.endpoints[slot])


def offset(segment_map, slot=0):
    """Height of a line along the first axis: the mean second coordinate of its ends."""
    return float(segment_map.segments_world.endpoints[slot, :, 1].mean())


def across(y, x0=0.0, x1=2.0):
    """A segment along the first axis, y to the left of it."""
    return [[x0, y], [x1, y]]


def assert_bitwise_equal(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def doubled(rules=GAMMA, **second):
    """An old line at y = 1 from x = 0 to 2, and a younger one."""
    m = seen(empty_map(rules), across(1.0), rules=rules)
    for _ in range(2):
        m = seen(m, across(1.0), slots=[0], rules=rules)
    ends = {"y": 1.005, "x0": 1.0, "x1": 3.0} | second
    return seen(m, across(**ends), rules=rules), across(**ends)


# New or known


def test_a_new_segment_takes_the_first_free_place():
    # seen 1 m ahead and 1 m to the left, from (10, 5) facing +Y
    at = pose(10, 5, np.pi / 2)
    one = seen(empty_map(GAMMA), [[1, 1], [2, 1]], at=at)
    np.testing.assert_array_equal(one.valid, [True] + [False] * (K - 1))
    np.testing.assert_allclose(ends_of(one), [[9, 6], [9, 7]], atol=1e-12)
    np.testing.assert_array_equal([one.updates[0], one.expected[0], one.unseen[0]], [1, 1, 0])
    two = seen(one, across(3.0), across(-3.0))
    np.testing.assert_array_equal(two.valid, [True] * 3 + [False] * (K - 3))
    np.testing.assert_allclose(ends_of(two, 2), across(-3.0), atol=1e-12)
    np.testing.assert_array_equal(ends_of(two), ends_of(one))


def test_a_known_segment_is_updated_in_its_place_and_no_other_is():
    m = seen(empty_map(GAMMA), across(1.0), across(3.0))
    after = seen(m, across(3.2), slots=[1])
    np.testing.assert_array_equal(after.valid, m.valid)
    np.testing.assert_array_equal(after.updates[:3], [1, 2, 0])
    np.testing.assert_array_equal(ends_of(after), ends_of(m))
    assert offset(after, 1) == pytest.approx(3.1)


def test_a_place_left_free_is_taken_again():
    m = seen(empty_map(GAMMA), across(1.0), across(2.0), across(3.0))
    m = dataclasses.replace(
        m, segments_world=Segments(m.segments_world.endpoints, m.valid.at[1].set(False))
    )
    m = seen(m, across(-4.0), across(-4.5))
    assert offset(m, 1) == pytest.approx(-4)
    assert offset(m, 3) == pytest.approx(-4.5)
    assert m.updates[1] == 1


def test_what_finds_no_place_is_counted_and_changes_nothing():
    m = seen(empty_map(GAMMA), *(across(1.0 * j) for j in (1, 2, 3)))
    full = seen(m, *(across(-1.0 * j) for j in (1, 2, 3, 4)))
    assert full.valid.sum() == 7
    after, overflow = see(full, *(across(0.1 * j) for j in (1, 2, 3)))
    assert overflow == 2
    assert after.valid.all()
    np.testing.assert_array_equal(ends_of(after, 3), ends_of(full, 3))
    again, overflow = see(after, across(4.5))
    assert overflow == 1
    np.testing.assert_array_equal(again.segments_world.endpoints, after.segments_world.endpoints)


def test_where_new_lines_begin_is_told():
    m, s = (
        seen(empty_map(GAMMA), across(1.0)),
        measurements_of(across(1.0), across(2.0), across(3.0)),
    )
    known = jnp.arange(M) < 1
    after, _, slot = grow(
        GAMMA, STIFF, m,
        of_image(s, known, s.valid & ~known),
    )  # fmt: skip
    np.testing.assert_array_equal(slot, [K, 1, 2] + [K] * (M - 3))
    assert offset(after, 2) == pytest.approx(3)


# Eq. (14)


def test_eq_14_worked_by_hand():
    """gamma = delta / (1 + delta): 1/2, then 2/3."""
    m = seen(empty_map(GAMMA), across(1.0))
    m = seen(m, across(1.2), slots=[0])
    assert offset(m) == pytest.approx(1 / 2 * 1.0 + 1 / 2 * 1.2)
    m = seen(m, across(1.4), slots=[0])
    assert offset(m) == pytest.approx(2 / 3 * 1.1 + 1 / 3 * 1.4)
    assert m.updates[0] == 3


def test_eq_14_is_the_running_mean(rng):
    rho, theta = 1 + 0.05 * rng.normal(size=6), 0.1 * rng.normal(size=6)
    m = empty_map(GAMMA)
    for i in range(6):
        d, n = np.array([np.cos(theta[i]), np.sin(theta[i])]), [-np.sin(theta[i]), np.cos(theta[i])]
        ends = [rho[i] * np.array(n) - d, rho[i] * np.array(n) + d]
        m = seen(m, ends, slots=[0] if i else None)
    np.testing.assert_allclose(m.line[0], [rho.mean(), theta.mean(), 1], rtol=1e-9)
    found = reference.polar_through(*ends_of(m))
    np.testing.assert_allclose(found, [rho.mean(), theta.mean()], rtol=1e-9)


def test_eq_14_acts_in_the_polar_form_of_the_moment():
    """Seen 20 cm too far from a turned robot: the line moves by half of that, there."""
    m = seen(empty_map(GAMMA), across(1.0, 0, 6))
    at = pose(3, 0.5, 0.2)
    error = np.array([-np.sin(-0.2), np.cos(-0.2)]) * 0.2  # across the line, in the nadir's axes
    ends = np.asarray(at.inverse().apply(jnp.array(across(1.0, 2, 5)))) + error
    m = seen(m, ends, at=at, slots=[0])
    np.testing.assert_allclose(ends_of(m)[:, 1], 1.1, atol=1e-9)


def test_the_side_a_segment_is_named_from_does_not_matter():
    for rules in (GAMMA, KALMAN):
        m = seen(empty_map(rules), across(1.0), rules=rules)
        there, back = (
            seen(m, ends, slots=[0], rules=rules) for ends in (across(1.2), across(1.2)[::-1])
        )
        np.testing.assert_allclose(ends_of(there), ends_of(back), atol=1e-9)


def named_both_ways(correlation=0.8):
    """One measurement with correlated errors of rho and theta, by either of its names."""
    for ends, sign in ((across(1.2), 1), (across(1.2)[::-1], -1)):
        covariance = jnp.array([[1.0, sign * correlation], [sign * correlation, 1.0]]) * 1e-2
        yield dataclasses.replace(
            measurements_of(ends), covariance=jnp.broadcast_to(covariance, (M, 2, 2))
        )


def test_correlated_errors_turn_with_the_name_when_lines_are_proposed():
    m = seen(empty_map(KALMAN), across(1.0), rules=KALMAN, sigma=0.1)
    m = dataclasses.replace(
        m, covariance=m.covariance.at[:, 0, 1].add(0.008).at[:, 1, 0].add(0.008)
    )
    there, back = (proposals(KALMAN, STIFF, m, s, pose()) for s in named_both_ways())
    assert there[2][0] == pytest.approx(float(back[2][0]))


def test_correlated_errors_turn_with_the_name_when_a_line_is_updated():
    m = seen(empty_map(KALMAN), across(1.0), rules=KALMAN, sigma=0.1)
    known = jnp.arange(M) < 1
    there, back = (
        grow(
        KALMAN, STIFF, m,
        of_image(s, known, ~known & s.valid),
    )[0]
        for s in named_both_ways()
    )  # fmt: skip
    np.testing.assert_allclose(there.line[0], back.line[0], rtol=1e-9)
    np.testing.assert_allclose(there.covariance[0], back.covariance[0], atol=1e-12)


def test_pieces_of_one_line_count_as_one_measurement():
    m = seen(empty_map(GAMMA), across(1.0, 0, 4))
    after = seen(m, across(1.2, 0, 1), across(1.4, 3, 4), slots=[0, 0])
    assert after.updates[0] == 2
    assert offset(after) == pytest.approx((1.0 + 1.3) / 2)


# Extend-only, R, L and rest


@pytest.mark.parametrize("rules", [GAMMA, KALMAN], ids=["gamma", "kalman"])
def test_a_segment_only_ever_grows(rules):
    m = seen(empty_map(rules), across(1.0, 0, 2), rules=rules)
    shorter = seen(m, across(1.0, 0.5, 1), slots=[0], rules=rules)
    np.testing.assert_allclose(ends_of(shorter), across(1.0, 0, 2), atol=1e-9)
    longer = seen(m, across(1.0, 1, 3), slots=[0], rules=rules)
    np.testing.assert_allclose(ends_of(longer), across(1.0, 0, 3), atol=1e-9)
    both = seen(m, across(1.0, -1, 0), across(1.0, 2.5, 4), slots=[0, 0], rules=rules)
    np.testing.assert_allclose(ends_of(both), across(1.0, -1, 4), atol=1e-9)


def test_the_ends_stay_on_the_line_that_moved():
    m = seen(empty_map(GAMMA), across(1.0, 0, 2))
    m = seen(m, [[0, 1.0], [3, 1.3]], slots=[0])
    slope = np.arctan(0.1) / 2  # half way between both directions
    found = reference.polar_through(*ends_of(m))
    assert found[1] == pytest.approx(slope)
    assert found[0] == pytest.approx((1.0 + np.cos(np.arctan(0.1))) / 2)


def test_what_is_farther_than_R_does_not_extend_a_segment():
    rim = np.sqrt(25 - 0.25)  # where a line half a metre aside leaves the disc of 5 m
    new = seen(empty_map(GAMMA), across(0.5, 1, 7))
    np.testing.assert_allclose(ends_of(new), across(0.5, 1, rim), atol=1e-9)
    known = seen(seen(empty_map(GAMMA), across(0.5, 0, 2)), across(0.5, 1, 9), slots=[0])
    np.testing.assert_allclose(ends_of(known), across(0.5, 0, rim), atol=1e-9)
    # but it moves it
    moved = seen(seen(empty_map(GAMMA), across(0.5, 0, 2)), across(0.7, 5.5, 9), slots=[0])
    np.testing.assert_allclose(ends_of(moved), across(0.6, 0, 2), atol=1e-9)


def test_what_lies_beyond_R_is_not_taken_into_the_map():
    for ends in (across(0.5, 5.1, 7), across(5.5, -1, 1)):
        m, overflow = see(empty_map(GAMMA), ends)
        assert not m.valid.any() and overflow == 0


def test_a_segment_longer_than_L_rests_and_may_then_grow_again():
    rules = dataclasses.replace(GAMMA, range=100.0, rest=3)
    m = seen(empty_map(rules), across(1.0, 0, 6), rules=rules)
    m = seen(m, across(1.2, 5, 11), slots=[0], rules=rules)
    assert m.resting[0] == 3
    np.testing.assert_allclose(ends_of(m), across(1.1, 0, 11), atol=1e-9)
    for left in (2, 1, 0):  # seen, and left as it is
        m = seen(m, across(2.0, 0, 20), slots=[0], rules=rules)
        assert (int(m.resting[0]), int(m.updates[0])) == (left, 2)
        np.testing.assert_allclose(ends_of(m), across(1.1, 0, 11), atol=1e-9)
    m = seen(m, across(1.4, 0, 20), slots=[0], rules=rules)
    assert (int(m.resting[0]), int(m.updates[0])) == (0, 3)
    np.testing.assert_allclose(ends_of(m), across(1.2, 0, 20), atol=1e-9)


def test_the_paper_rests_at_twice_R():
    assert MapConfig().length == 2 * MapConfig().range == 10


# Forgetting and counting


# Heights
