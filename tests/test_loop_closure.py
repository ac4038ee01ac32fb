"""A constellation is found where it is and nowhere else; the error is spread as the paper says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sofjax.geometry import SE2
from sofjax.loop_closure import ClosingConfig, distribute, find

SIGMA = np.array([0.4, 0.4, 0.03])
RULES = ClosingConfig()


def blocks(period, count, irregular=0.0, seed=4):
    """Dark blocks along both sides of a corridor, their four edges each; every `period` metres."""
    rng = np.random.default_rng(seed)
    segments = []
    for i in range(count):
        for y in (-0.6, 0.6):
            x = period * i + irregular * rng.uniform(-1, 1)
            w, h = 0.45 + irregular * rng.uniform(-0.5, 0.5), 0.2
            corners = np.array([[x, y - h], [x + w, y - h], [x + w, y + h], [x, y + h]])
            segments += [np.stack([corners[j], corners[(j + 1) % 4]]) for j in range(4)]
    return np.array(segments)


def seen_again(segments, x, y, yaw, rng):
    """The same, as a drifted path would describe it."""
    T = SE2(jnp.array([x, y]), jnp.asarray(yaw)).inverse()
    return np.asarray(T.apply(jnp.asarray(segments))) + rng.normal(0, 0.005, segments.shape)


@pytest.mark.parametrize("backward", [False, True])
def test_a_place_is_found_where_it_is(rng, backward):
    earlier = blocks(1.1, 6, irregular=0.3)
    later = seen_again(earlier[16:32], 0.5, -0.3, 0.04, rng)
    if backward:  # driven the other way: the ends in the other order
        later = later[:, ::-1]
    closing = find(RULES, later, earlier, SIGMA)
    assert closing.accepted, closing.reason
    np.testing.assert_allclose(closing.T_correction.xy, [0.5, -0.3], atol=0.01)
    np.testing.assert_allclose(closing.T_correction.yaw, 0.04, atol=0.006)
    assert closing.pairs[:, 1].tolist() == (16 + closing.pairs[:, 0]).tolist()
    assert len(closing.pairs) >= 14


@pytest.mark.parametrize(
    ("earlier", "later", "why"),
    [
        (blocks(0.8, 8), blocks(0.8, 8)[16:32], "another place"),  # a row: one block off fits too
        (blocks(1.1, 6, 0.3), blocks(1.1, 6, 0.3, seed=5)[16:32], ""),  # another place ...
        (blocks(1.1, 6, 0.3), blocks(1.3, 6, 0.35)[16:32], ""),  # ... and one that is much like it
        (blocks(1.1, 6, 0.3)[::2], blocks(1.1, 6, 0.3)[16:32:2], "one way"),  # no end is seen
        (blocks(1.1, 6, 0.3)[:3], blocks(1.1, 6, 0.3)[:3], "too few"),
    ],
)
def test_what_is_not_sure_is_refused(earlier, later, why):
    closing = find(RULES, later, earlier, SIGMA)
    assert not closing.accepted and why in closing.reason


def test_the_error_is_spread_evenly_back_along_the_way(x64):
    T = SE2(jnp.stack([jnp.linspace(0, 4, 9), jnp.zeros(9)], axis=1), jnp.zeros(9))
    travelled = T.xy[:, 0]
    moved, motion = distribute(T, travelled, SE2(jnp.array([0.0, 0.8]), jnp.zeros(())))
    np.testing.assert_allclose(moved.xy[:, 1], 0.2 * travelled, atol=1e-12)  # in proportion
    np.testing.assert_allclose(moved.xy[0], [0, 0])
    again = jax.vmap(lambda m, T: m @ T)(motion, T)
    np.testing.assert_allclose(again.xy, moved.xy, atol=1e-12)
    # a turn as well: the last pose comes to stand where it should
    correction = SE2(jnp.array([0.3, -0.2]), jnp.asarray(0.1))
    moved, _ = distribute(T, travelled, correction)
    want = correction @ SE2(T.xy[-1], T.yaw[-1])
    np.testing.assert_allclose(moved.xy[-1], want.xy, atol=1e-12)
    np.testing.assert_allclose(moved.yaw, 0.1 * travelled / 4, atol=1e-12)


def test_no_error_moves_nothing(x64, rng):
    T = SE2(jnp.asarray(rng.normal(size=(5, 2))), jnp.asarray(rng.normal(size=5)))
    moved, _ = distribute(T, jnp.arange(5.0), SE2.identity())
    np.testing.assert_allclose(moved.xy, T.xy, atol=1e-12)
    np.testing.assert_allclose(moved.yaw, T.yaw, atol=1e-12)
