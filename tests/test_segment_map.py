"""The one map of segments, rule by rule; III.B."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from conftest import jit_quickly

from sofjax.geometry import SE2, Mount, PolarLine, Segments
from sofjax.geometry.lines import polar_through
from sofjax.likelihood.measurements import Measurements
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.segment_map import (
    MapConfig,
    Observed,
    SegmentMap,
    candidate_associations,
    empty_map,
    in_view,
    integrate,
    is_off_floor,
    nearby,
    posterior_given_class,
    predict_measurement,
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


def assert_bitwise_equal(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def across(y, x0=0.0, x1=2.0):
    """A segment along the first axis, y to the left of it."""
    return [[x0, y], [x1, y]]


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


# Doubled lines


def doubled(rules=GAMMA, **second):
    """An old line at y = 1 from x = 0 to 2, and a younger one."""
    m = seen(empty_map(rules), across(1.0), rules=rules)
    for _ in range(2):
        m = seen(m, across(1.0), slots=[0], rules=rules)
    ends = {"y": 1.005, "x0": 1.0, "x1": 3.0} | second
    return seen(m, across(**ends), rules=rules), across(**ends)


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


def test_a_off_floor_line_does_not_join_the_floor_line_below_it():
    m, ends = doubled(KALMAN)
    off_floor = dataclasses.replace(
        m,
        line=m.line.at[0, 2].set(1.2),
        covariance=m.covariance.at[0, 2].set(0).at[0, :, 2].set(0).at[0, 2, 2].set(1e-4),
    )
    assert seen(off_floor, ends, slots=[1], rules=KALMAN).valid.sum() == 2


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


# Forgetting and counting


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


# Heights


def off_floor_view(T, y, z, x0=0.0, x1=3.0, h=0.6):
    """Ends on the floor of a line at height z as they appear from a nadir."""
    apparent_scale = h / (h - z)
    return apparent_scale * np.asarray(T.inverse().apply(jnp.array(across(y, x0, x1))))


PATH = [(0.1 * i, 0.08 * i, 0.05 * i) for i in range(9)]


def drive_past(z, rules=KALMAN, sigma=0.005):
    """A line 1 m to the left, seen ever nearer."""
    m = empty_map(rules)
    for i, T in enumerate(pose(*where) for where in PATH):
        ends = off_floor_view(T, 1.0, z)
        m = seen(m, ends, at=T, slots=[0] if i else None, rules=rules, sigma=sigma)
    return m


@pytest.mark.parametrize("z", [0.0, 0.1, -0.4])
def test_the_height_of_a_line_is_found_from_all_its_views(z):
    m = drive_past(z)
    apparent_scale = 0.6 / (0.6 - z)
    sigma = float(np.sqrt(m.covariance[0, 2, 2]))
    assert abs(m.line[0, 2] - apparent_scale) < 1e-3
    assert sigma < 0.05
    assert bool(is_off_floor(KALMAN, m.line[0], m.covariance[0])) == (z != 0)
    # and the segment lies where the line is, not where it appears from anywhere
    np.testing.assert_allclose(ends_of(m)[:, 1], 1.0, atol=2e-3)


def test_a_off_floor_line_grows_to_where_it_ends_and_not_to_where_it_appears_to():
    m, T = drive_past(0.1), pose(*PATH[-1])
    apparent = off_floor_view(T, 1.0, 0.1, 1.0, 4.2)
    m = seen(m, apparent, at=T, slots=[0], rules=KALMAN, sigma=0.005)
    assert T.apply(jnp.asarray(apparent))[1, 0] > 4.8
    assert ends_of(m)[:, 0].max() == pytest.approx(4.2, abs=0.01)


@pytest.mark.parametrize(
    ("apparent_scale", "sigma", "expected"),
    [
        (1.2, 0.05, True),
        (1.2, 0.07, False),  # less than three sigmas from 1
        (1.03, 1e-4, False),  # as good as on the floor
        (0.8, 1e-4, False),  # nothing lies just under a floor
        (0.5, 0.1, True),  # a reflection lies deep
        (1.0, 1e-9, False),
    ],
)
def test_a_line_is_off_floor_if_all_its_views_say_so(apparent_scale, sigma, expected):
    line, covariance = (
        jnp.array([1.0, 0.0, apparent_scale]),
        jnp.diag(jnp.array([1.0, 1.0, sigma**2])),
    )
    assert bool(is_off_floor(KALMAN, line, covariance)) == expected
    assert not is_off_floor(GAMMA, line, covariance)  # the paper knows no heights


def test_a_line_taken_for_floor_is_conditioned_on_its_height(rng):
    """As the regression of (rho, theta) on the apparent scale says, of many draws."""
    root = np.array([[0.1, 0, 0], [0.02, 0.05, 0], [0.03, -0.01, 0.04]])
    line, covariance = np.array([1.0, 0.2, 1.02]), root @ root.T
    found, left = posterior_given_class(KALMAN, jnp.asarray(line), jnp.asarray(covariance))
    x = rng.multivariate_normal(line, covariance, size=200_000)
    A = np.column_stack([x[:, 2] - 1, np.ones(len(x))])
    fit, *_ = np.linalg.lstsq(A, x[:, :2])
    np.testing.assert_allclose(found, [*fit[1], 1], atol=1e-3)
    residual = np.cov((x[:, :2] - A @ fit).T)
    np.testing.assert_allclose(left[:2, :2], residual, rtol=0.03, atol=1e-5)
    np.testing.assert_allclose(left[2], 0, atol=1e-12)


def test_a_off_floor_line_is_taken_as_it_is():
    line, covariance = jnp.array([1.0, 0.2, 1.3]), jnp.diag(jnp.array([0.1, 0.1, 1e-4]))
    assert_bitwise_equal(posterior_given_class(KALMAN, line, covariance), (line, covariance))


@pytest.mark.parametrize("z", [0.0, 0.15, -0.3])
def test_a_line_appears_from_elsewhere_as_the_camera_will_see_it(camera, mounts, z, rng):
    """Ends at a height, projected by a tilted camera with a lever arm and put on the floor."""
    checked = 0
    for mount in mounts:
        if float(mount.height) < z + 0.05:
            continue
        first, second = rng.normal(size=(2, 3)) * [0.3, 0.3, 0.3]
        true = np.column_stack([rng.normal(size=(2, 2)) * 3, [z, z]])
        views = []
        for where in (first, second):
            pixels, _ = reference.project(camera.K, mount, where, true)
            H_F = reference.floor_homography(camera.K, mount, where)
            X = np.column_stack([pixels, np.ones(2)]) @ np.linalg.inv(H_F).T
            nadir = pose(*where) @ mount.T_robot_nadir
            ends = nadir.inverse().apply(jnp.asarray(X[:, :2] / X[:, 2:]))
            views.append((nadir, polar_through(ends)))
        (anchor, line), (there, expected) = views
        apparent_scale = float(mount.height) / (float(mount.height) - z)
        found, H = predict_measurement(
            jnp.array([line.rho, line.theta, apparent_scale]), anchor, there
        )
        d = reference.polar_difference((found[0], found[1]), (expected.rho, expected.theta))
        np.testing.assert_allclose(d, 0, atol=1e-7)
        by_difference = jax.jacfwd(lambda a, b, c: predict_measurement(a, b, c)[0][:2])(
            jnp.array([line.rho, line.theta, apparent_scale]), anchor, there
        )
        np.testing.assert_allclose(H, by_difference, atol=1e-9)
        checked += 1
    assert checked > 3


def test_the_kalman_rule_is_a_plain_extended_kalman_filter(rng):
    rules = dataclasses.replace(KALMAN, rho_drift=0.003, theta_drift=0.002)
    m, x, P = empty_map(rules), None, None
    R = np.diag([0.005**2 + 0.003**2, 0.005**2 + 0.002**2])
    for i, T in enumerate(pose(*where) for where in PATH):
        ends = off_floor_view(T, 1.0, 0.05) + 0.003 * rng.normal(size=(2, 2))
        rho, theta = reference.polar_through(*ends)
        m = seen(m, ends, at=T, slots=[0] if i else None, rules=rules, sigma=0.005)
        if i == 0:
            x, P = np.array([rho, theta, 1.0]), np.diag([0.005**2, 0.005**2, 0.3**2])
            continue
        t = np.asarray(T.xy)  # the anchor is the origin
        n, d = np.array([-np.sin(x[1]), np.cos(x[1])]), np.array([np.cos(x[1]), np.sin(x[1])])
        expected = (x[0] - x[2] * n @ t, x[1] - float(T.yaw))
        H = np.array([[1, x[2] * d @ t, -n @ t], [0, 1, 0]])
        gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x = x + gain @ reference.polar_difference((rho, theta), expected)
        P = P - gain @ H @ P
        np.testing.assert_allclose(m.line[0], x, rtol=1e-9)
        np.testing.assert_allclose(m.covariance[0], P, rtol=1e-6, atol=1e-12)


def test_two_pieces_of_one_line_inform_as_two_measurements_would():
    m = seen(empty_map(KALMAN), across(1.0, 0, 4), rules=KALMAN)
    pieces = across(1.01, 0, 1), across(0.98, 3, 4)
    together = seen(m, *pieces, slots=[0, 0], rules=KALMAN)
    one_by_one = m
    for piece in pieces:
        one_by_one = seen(one_by_one, piece, slots=[0], rules=KALMAN)
    np.testing.assert_allclose(together.line[0], one_by_one.line[0], rtol=1e-9)
    np.testing.assert_allclose(together.covariance[0], one_by_one.covariance[0], rtol=1e-6)


def test_a_jitter_is_taken_out_of_what_is_integrated():
    measurements = dataclasses.replace(
        measurements_of(across(1.03)),
        by_jitter=jnp.broadcast_to(jnp.array([[3.0, 0.0], [0.0, 0.0]]), (M, 2, 2)),
    )
    m = seen(empty_map(GAMMA), across(1.0))
    known = jnp.arange(M) < 1
    after, *_ = grow(
        GAMMA, STIFF, m,
        of_image(measurements, known, ~known & measurements.valid, jitter=(0.01, 0.0)),
    )  # fmt: skip
    assert offset(after) == pytest.approx(1.0)


# Candidates and view


def random_map(rng):
    roots = rng.normal(size=(K, 3, 3)) * [[0.02], [0.02], [0.05]]
    line = np.column_stack(
        [rng.normal(size=K), rng.uniform(-3, 3, K), rng.choice([1.0, 1.02, 1.4], K)]
    )
    anchors = rng.normal(size=(K, 3)) * [0.5, 0.5, 1]
    ends = rng.normal(size=(K, 2, 2)) * 2
    m = SegmentMap(
        Segments(jnp.asarray(ends), jnp.asarray(rng.random(K) < 0.8)),
        SE2(jnp.asarray(anchors[:, :2]), jnp.asarray(anchors[:, 2])),
        jnp.asarray(line),
        jnp.asarray(np.einsum("kij,klj->kil", roots, roots) + 1e-6 * np.eye(3)),
        *(jnp.ones(K, int) for _ in range(4)),
    )
    return m


@pytest.mark.parametrize("propagate", [True, False])
def test_the_candidates_are_the_nearest_lines_of_a_loop_over_all_pairs(propagate, rng):
    rules = dataclasses.replace(KALMAN, rho_drift=0.01, theta_drift=0.02, candidates=3)
    sensor = SensorModel(propagate=propagate, tilt_sigma=0.05)
    for _ in range(3):
        m = random_map(rng)
        measurements = dataclasses.replace(
            measurements_of(*(rng.normal(size=(M, 2, 2)))),
            by_jitter=jnp.asarray(rng.normal(size=(M, 2, 2))),
        )
        at = pose(*rng.normal(size=3) * 0.3)
        candidates, slot, nearest = proposals(rules, sensor, m, measurements, at)
        for i in range(M):
            errors, kept = np.full(K, np.inf), {}
            for k in range(K):
                anchor = SE2(m.anchor.xy[k], m.anchor.yaw[k])
                line, P = posterior_given_class(rules, m.line[k], m.covariance[k])
                seen_line, H = predict_measurement(line, anchor, at)
                S = np.asarray(measurements.covariance[i]) + np.diag([0.01**2, 0.02**2])
                opposite = np.cos(measurements.line.theta[i] - seen_line[1]) < 0
                by_its_name = np.diag([-1, 1]) if opposite else np.eye(2)
                S = S + (by_its_name @ np.asarray(H @ P @ H.T) @ by_its_name if propagate else 0)
                J = np.asarray(measurements.by_jitter[i])
                S_tilt = S + 0.05**2 * J @ J.T
                extent = float(seen_line[2]) * at.inverse().apply(m.segments_world.endpoints[k])
                if m.valid[k] and reference.overlap(extent, measurements.endpoints_nadir[i]) > -0.3:
                    line_i = (measurements.line.rho[i], measurements.line.theta[i])
                    d = np.array(reference.polar_difference(line_i, seen_line[:2]))
                    errors[k] = d @ np.linalg.inv(S_tilt) @ d
                    kept[k] = (S, S_tilt, seen_line)
            order = [k for k in np.argsort(errors)[:3] if np.isfinite(errors[k])]
            assert nearest[i] == pytest.approx(errors.min(), rel=1e-6)
            assert candidates.valid[i].sum() == len(order)
            np.testing.assert_array_equal(slot[i, : len(order)], order)
            for j, k in enumerate(order):
                S, S_tilt, seen_line = kept[k]
                np.testing.assert_allclose(candidates.precision[i, j], np.linalg.inv(S), rtol=1e-6)
                np.testing.assert_allclose(
                    candidates.precision_with_jitter[i, j], np.linalg.inv(S_tilt), rtol=1e-6
                )
                found = (
                    candidates.line.rho[i, j],
                    candidates.line.theta[i, j],
                    candidates.apparent_scale[i, j],
                )
                np.testing.assert_allclose(found, seen_line, atol=1e-9)


def test_an_empty_map_proposes_nothing():
    candidates, _, nearest = proposals(
        KALMAN, STIFF, empty_map(KALMAN), measurements_of(across(1.0)), pose()
    )
    assert not candidates.valid.any()
    np.testing.assert_array_equal(nearest, jnp.inf)
    for leaf in jax.tree.leaves(candidates):
        assert np.isfinite(leaf).all()


def test_a_piece_beyond_the_end_of_its_line_is_proposed_up_to_the_gap():
    m = seen(empty_map(KALMAN), across(1.0, 0, 2), rules=KALMAN)
    for x0, expected in ((2.2, True), (2.4, False)):
        candidates, _, nearest = proposals(
            KALMAN, STIFF, m, measurements_of(across(1.0, x0, 3)), pose()
        )
        assert bool(candidates.valid[0, 0]) == expected
        assert bool(np.isfinite(nearest[0])) == expected


def test_the_lines_nearby_are_all_that_a_loop_finds_within_reach(rng):
    """If they are no more than L; else the nearest, and what is left out within reach is told."""
    m, at = random_map(rng), pose(0.4, -0.3, 1.0)
    distance = []
    for ends, apparent_scale in zip(m.segments_world.endpoints, m.line[:, 2], strict=True):
        a, b = np.asarray(ends) - np.asarray(at.xy)
        points = a + np.linspace(0, 1, 100_001)[:, None] * (b - a)
        distance.append(float(apparent_scale) * np.linalg.norm(points, axis=1).min())
    order = [k for k in np.argsort(distance) if m.valid[k]]
    assert 4 < len(order) < K
    for L in (1, 3, len(order), K):
        reach = 0.5 * (distance[order[3]] + distance[order[4]])  # four of them lie within it
        slots, truncated = nearby(dataclasses.replace(KALMAN, nearby=L), m, at, jnp.array(reach))
        found = [int(k) for k in slots if k < K]
        assert found == sorted(order[: len(found)]) and len(found) <= L
        assert truncated == max(0, 4 - len(found))
        assert len(found) == len(order) or L < len(order)
        taken = m.take(slots)
        np.testing.assert_array_equal(taken.valid, np.asarray(slots) < K)
        assert_bitwise_equal(m.put(slots, taken), m)


def test_lines_beyond_those_nearby_only_age():
    rules = dataclasses.replace(GAMMA, nearby=2)
    m = seen(empty_map(rules), across(1.0), across(2.0), rules=rules)
    m = seen(m, across(1.0), at=pose(0, 29), rules=rules)
    before = m.unseen[:3]
    near, _ = nearby(rules, m, pose(), jnp.array(6.0))
    np.testing.assert_array_equal(near, [0, 1])
    known = jnp.arange(M) < 1
    after, *_ = jit_quickly(integrate)(
        rules, STIFF, m,
        Observed(
            measurements_of(across(2.2)), jnp.zeros(2), pose(), near, jnp.zeros(2, bool),
            jnp.ones(M, int), known, everything(len(near)), ~known & known,
        ),
    )  # fmt: skip
    np.testing.assert_array_equal(after.updates[:3], [1, 2, 1])
    np.testing.assert_array_equal(
        after.unseen[:3], before * jnp.array([1, 0, 1]) + jnp.array([1, 0, 1])
    )
    np.testing.assert_array_equal(ends_of(after, 2), ends_of(m, 2))
    assert offset(after, 1) == pytest.approx(2.1)


def test_what_was_seen_too_long_ago_is_not_looked_for():
    m = seen(empty_map(GAMMA), across(1.0), across(2.0))
    m = seen(m, across(1.0), slots=[0])
    for recall, slots in ((0, [0]), (1, [0, 1])):
        rules = dataclasses.replace(GAMMA, recall=recall)
        near, truncated = nearby(rules, m, pose(), jnp.array(6.0))
        assert [int(k) for k in near if k < m.updates.shape[0]] == slots and truncated == 0


def test_what_is_in_view_worked_by_hand(camera):
    level = Mount.create(height=1.0)  # the image ends 270 / 120 m ahead
    middles = [(3, 0), (2.0, 0), (4, 1.5), (4, 3.0), (-3, 0), (5.5, 0)]
    expected = [True, False, True, False, False, False]
    ends = np.zeros((K, 2, 2))
    for k, middle in enumerate(middles):
        ends[k] = np.add(middle, [[-0.2, -0.1], [0.2, 0.1]])
    m = dataclasses.replace(
        empty_map(KALMAN), segments_world=Segments(jnp.asarray(ends), jnp.arange(K) < len(middles))
    )
    shown = functools.partial(in_view, KALMAN, camera, level)
    np.testing.assert_array_equal(shown(m, pose())[: len(middles)], expected)
    # a line over the floor appears farther away
    high = dataclasses.replace(m, line=m.line.at[1, 2].set(1.5))
    assert shown(high, pose())[1]
    # the same from elsewhere, turned
    T = pose(2, -1, 2.0)
    there = Segments(T.apply(m.segments_world.endpoints), m.valid)
    moved = dataclasses.replace(m, segments_world=there)
    np.testing.assert_array_equal(shown(moved, T)[: len(middles)], expected)


def test_a_line_and_its_polar_form_agree_about_the_anchor():
    m = seen(empty_map(KALMAN), across(1.0), at=pose(50, 20, 1.0), rules=KALMAN)
    line = PolarLine(m.line[0, 0], m.line[0, 1])
    np.testing.assert_allclose([line.rho, line.theta], [1, 0], atol=1e-9)
    np.testing.assert_allclose([*m.anchor.xy[0], m.anchor.yaw[0]], [50, 20, 1])
