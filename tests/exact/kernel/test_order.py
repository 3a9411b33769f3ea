"""The order of every sum, which is the model's alone: known by its bits."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

from purerl import exact
from purerl.exact.kernel import lanes, reading, values
from tests.exact.kernel import by_one_lane, needs_compiler

TERMS = np.random.default_rng(0).normal(size=(16, 100)).astype(np.float32)


def in_turn(row):
    return functools.reduce(lambda a, b: np.float32(a + b), row)


def by_lanes(row):
    """As `lanes.py` says."""
    each = np.array([in_turn(row[lane::32]) for lane in range(32)])
    for far in (16, 8, 4, 2, 1):
        each = each[:far] + each[far : 2 * far]
    return each[0]


def sums(table):
    return (
        table.sum(1),
        jnp.concatenate([table, table]).sum(1),
        table[:, :31].sum(1),
        table[:, :4].sum(1),
    )


@needs_compiler
def test_a_sum_has_the_order_that_is_promised():
    kernel = exact.compile_kernel(sums, TERMS)
    shared, many, short, few = by_one_lane(kernel.text, TERMS.reshape(1, -1))
    assert (shared[0] == [by_lanes(row) for row in TERMS]).all()
    assert (many[0, :16] == [in_turn(row) for row in TERMS]).all()
    assert (short[0] == [in_turn(row[:31]) for row in TERMS]).all()
    assert (few[0] == [in_turn(row[:4]) for row in TERMS]).all()
    assert (shared[0] != many[0, :16]).any(), "the two orders must be told apart"


@needs_compiler
def test_an_environments_bits_do_not_depend_on_how_many_there_are():
    kernel = exact.compile_kernel(sums, TERMS)
    several = np.stack([TERMS.reshape(-1), 2 * TERMS.reshape(-1), TERMS.reshape(-1)])
    alone = by_one_lane(kernel.text, several[2:])
    together = by_one_lane(kernel.text, several)
    assert all((x[0] == y[2]).all() for x, y in zip(alone, together, strict=True))


def folds_of(function, *example):
    import jax

    program = reading.read(jax.make_jaxpr(function)(*example))
    return [x for x in program.block.items if isinstance(x, values.Fold)]


J = np.ones((40, 6), np.float32)


def of_parts(j, d):
    rows = jnp.concatenate([j[:9], 2 * j[9:]])
    return jnp.einsum("ki,k,kj->ij", rows, d, rows)


@pytest.mark.parametrize(
    "width, function",
    [
        (6, lambda j, d: j.T @ (d[:, None] * j)),
        (6, of_parts),
        (0, lambda j, d: j.T @ (d[:, None] * jnp.sin(j))),
        (0, lambda j, d: j.T @ (d[:, None] + j)),
        (0, lambda j, d: j[:, :3].T @ (j * d[:, None])),
    ],
)
def test_a_square_of_sums_is_halved_where_it_is_symmetric(width, function):
    (fold,) = folds_of(function, J, J[:, 0])
    assert lanes.width_of(fold) == width
