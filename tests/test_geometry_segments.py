"""Segments: length, overlap along the second, and clipping by an affine function."""

import jax.numpy as jnp
import numpy as np
import pytest
import reference

from sofjax.geometry import SE2, Segments, overlap
from sofjax.geometry.segments import clip

pytestmark = pytest.mark.usefixtures("x64")


def array(*ends):
    return jnp.array(ends, float)


@pytest.mark.parametrize(
    ("first", "second", "shared"),
    [
        (((0, 0), (2, 0)), ((1, 0), (5, 0)), 1),
        (((1, 3), (2, 9)), ((0, 0), (5, 0)), 1),  # projected onto the second
        (((0, 0), (5, 0)), ((1, 0), (3, 0)), 2),  # contained
        (((0, 0), (1, 0)), ((3, 0), (5, 0)), -2),  # a gap
        (((0, 0), (1, 0)), ((1, 0), (5, 0)), 0),  # touching
        (((0, 0), (0, 7)), ((-1, 0), (1, 0)), 0),  # across
        (((0, 0), (4, 0)), ((2, 0), (2, 0)), 0),  # no direction
        (((2, 0), (2, 0)), ((0, 0), (4, 0)), 0),  # no length
    ],
)
def test_an_overlap_worked_by_hand(first, second, shared):
    assert overlap(array(*first), array(*second)) == pytest.approx(shared)


def test_overlap_does_not_depend_on_the_directions_nor_on_the_frame(rng):
    for first, second in jnp.asarray(rng.normal(size=(20, 2, 2, 2))):
        shared = overlap(first, second)
        assert shared == pytest.approx(reference.overlap(first, second))
        assert overlap(first[::-1], second) == pytest.approx(shared)
        assert overlap(first, second[::-1]) == pytest.approx(shared)
        T = SE2(jnp.asarray(rng.normal(size=2)), jnp.asarray(rng.normal()))
        assert overlap(T.apply(first), T.apply(second)) == pytest.approx(shared)


def test_overlap_is_no_longer_than_either_segment(rng):
    for first, second in jnp.asarray(rng.normal(size=(20, 2, 2, 2))):
        lengths = [float(jnp.linalg.norm(s[1] - s[0])) for s in (first, second)]
        assert overlap(first, second) <= min(lengths) + 1e-12


@pytest.mark.parametrize(
    ("above", "kept"),
    [
        ((1, 2), ((0, 0), (4, 0))),
        ((1, -1), ((0, 0), (2, 0))),
        ((-1, 3), ((1, 0), (4, 0))),
        ((0, 1), ((0, 0), (4, 0))),
        ((1, 0), ((0, 0), (4, 0))),
        ((-1, -2), None),
        ((0, 0), None),
        ((0, -1), None),
    ],
)
def test_clipping_worked_by_hand(above, kept):
    segment = array((0, 0), (4, 0))
    part, some = clip(segment, jnp.array(above, float))
    assert bool(some) == (kept is not None)
    np.testing.assert_allclose(part, segment if kept is None else kept)


def test_what_is_clipped_away_is_where_the_function_is_negative(rng):
    normal, offset = jnp.array([0.6, -0.8]), 0.3
    for segment in jnp.asarray(rng.normal(size=(40, 2, 2))):
        above = segment @ normal + offset
        part, some = clip(segment, above)
        if some:
            values = part @ normal + offset
            assert (values > -1e-12).all()
            assert values.max() == pytest.approx(float(above.max()))
            if (above < 0).any():
                assert values.min() == pytest.approx(0, abs=1e-12)
            assert (part[1] - part[0]) @ (segment[1] - segment[0]) >= 0  # the same direction
        else:
            assert (above <= 0).all()


def test_length_and_frames_worked_by_hand():
    segments = Segments(array(((0, 0), (3, 4)), ((1, 1), (1, 1))), jnp.array([True, False]))
    np.testing.assert_allclose(segments.length, [5, 0])
    moved = segments.transform(SE2(jnp.array([1.0, 0.0]), jnp.array(np.pi / 2)))
    np.testing.assert_allclose(moved.endpoints[0], [[1, 0], [-3, 3]], atol=1e-12)
    np.testing.assert_array_equal(moved.valid, segments.valid)
