"""Angles, and the functions that are safe at zero."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sofjax.geometry.angles import (
    safe_arctan2,
    safe_divide,
    safe_norm,
    safe_sqrt,
    wrap,
    wrap_axial,
)

pytestmark = pytest.mark.usefixtures("x64")


def test_angles_worked_by_hand():
    np.testing.assert_allclose(
        wrap(jnp.array([0.0, 3.5, -3.5, 7.0])), [0, 3.5 - 2 * np.pi, 2 * np.pi - 3.5, 7 - 2 * np.pi]
    )
    np.testing.assert_allclose(
        wrap_axial(jnp.array([0.0, 2.0, -2.0, 3.2])), [0, 2 - np.pi, np.pi - 2, 3.2 - np.pi]
    )


@pytest.mark.parametrize(("function", "period"), [(wrap, 2 * np.pi), (wrap_axial, np.pi)])
def test_a_wrapped_angle_is_small_and_congruent(function, period, rng):
    angle = np.concatenate([rng.uniform(-50, 50, 500), np.arange(-9, 10) * np.pi / 2])
    wrapped = np.asarray(function(jnp.asarray(angle)))
    assert (np.abs(wrapped) <= period / 2 + 1e-12).all()
    turns = (angle - wrapped) / period
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)


def test_safe_functions_are_the_plain_ones_where_those_are_defined(rng):
    x, y = rng.normal(size=(2, 50))
    np.testing.assert_allclose(safe_sqrt(jnp.asarray(x**2)), np.abs(x))
    np.testing.assert_allclose(safe_norm(jnp.asarray(np.stack([x, y], 1))), np.hypot(x, y))
    np.testing.assert_allclose(safe_divide(jnp.asarray(x), jnp.asarray(y)), x / y)
    np.testing.assert_allclose(safe_arctan2(jnp.asarray(y), jnp.asarray(x)), np.arctan2(y, x))
    axes = np.array([[0, 1], [0, -1], [1, 0], [-1, 0]], float)
    np.testing.assert_allclose(
        safe_arctan2(jnp.asarray(axes[:, 0]), jnp.asarray(axes[:, 1])),
        np.arctan2(axes[:, 0], axes[:, 1]),
    )


@pytest.mark.parametrize(
    ("function", "at"),
    [
        (safe_sqrt, (0.0,)),
        (safe_sqrt, (-1.0,)),
        (lambda x, y: safe_norm(jnp.stack([x, y])), (0.0, 0.0)),
        (safe_divide, (1.0, 0.0)),
        (safe_divide, (0.0, 0.0)),
        (safe_arctan2, (0.0, 0.0)),
    ],
)
def test_safe_functions_and_their_gradients_are_zero_where_the_plain_ones_are_not_defined(
    function, at
):
    at = tuple(jnp.asarray(a) for a in at)
    numbers = range(len(at))
    assert function(*at) == 0
    for gradient in (jax.grad(function, numbers)(*at), jax.jacfwd(function, numbers)(*at)):
        np.testing.assert_array_equal(jnp.stack(gradient), 0)
