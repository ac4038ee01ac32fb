"""Half of the rows where that is enough, alone and in batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sofjax._pytree import half_if_enough, in_any_run


def sum_of_squares(there, values):
    """Over the rows that are there; and of how many rows it was worked out."""

    def of(rows):
        there, values = rows
        return jnp.sum(jnp.where(there, values**2, 0)), jnp.array(len(there))

    return half_if_enough(of, (there, values), there)


def rows(*there, M=8):
    return jnp.zeros(M, bool).at[jnp.array(there, int)].set(True)


@pytest.mark.parametrize(("there", "worked_out"), [((), 4), ((0, 3), 4), ((4,), 8), ((0, 7), 8)])
def test_the_first_half_is_enough_where_the_second_holds_nothing(there, worked_out):
    values = jnp.arange(1.0, 9)
    total, of = sum_of_squares(rows(*there), values)
    assert total == sum((i + 1) ** 2 for i in there)
    assert of == worked_out


@pytest.mark.parametrize("M", [1, 3])
def test_an_odd_row_belongs_to_the_first_half(M):
    total, of = sum_of_squares(rows(M - 1, M=M), jnp.ones(M))
    assert total == 1
    assert of == M


def test_a_batch_works_out_all_rows_if_any_of_its_runs_needs_them():
    few, many = rows(0, 1), rows(1, 6)
    values = jnp.ones(8)
    for batch, worked_out in ((few, few), 4), ((few, many), 8):
        total, of = jax.vmap(sum_of_squares, in_axes=(0, None))(jnp.stack(batch), values)
        np.testing.assert_array_equal(total, [2, 2])
        np.testing.assert_array_equal(of, worked_out)


def test_a_condition_stays_one_for_batches_of_batches():
    """By `vmap` alone it would become a `select`, which works out either side."""
    choose = lambda condition, x: jax.lax.cond(in_any_run(condition), jnp.sin, jnp.cos, x)
    twice = jax.vmap(jax.vmap(choose))
    conditions, x = jnp.zeros((2, 3), bool), jnp.zeros((2, 3))
    assert " cond[" in str(jax.make_jaxpr(twice)(conditions, x))
    np.testing.assert_array_equal(twice(conditions, x), 1)
    np.testing.assert_array_equal(twice(conditions.at[1, 2].set(True), x), 0)


def test_derivatives_go_through_either_half():
    values = jnp.arange(8.0)
    for there in (rows(1, 2), rows(2, 7)):
        for slope in (jax.grad, jax.jacfwd):
            found = slope(lambda v, there=there: sum_of_squares(there, v)[0])(values)
            np.testing.assert_allclose(found, jnp.where(there, 2 * values, 0))
