"""The order of every sum, which is the model's alone: known by its bits."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl import exact
from purerl.exact.kernel import lanes, reading, values
from tests.exact.kernel import by_one_lane, by_warps, needs_compiler

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


# Joints that move a contact: six of each, and four more of some.
MOVED = np.zeros((150, 64), bool)
MOVED[:, :6] = True
for _row in range(0, 150, 2):
    MOVED[_row, 6 + _row % 54 :][:4] = True
ROWS = np.random.default_rng(1).normal(size=MOVED.shape).astype(np.float32)


def jacobian(rows):
    return jnp.where(rows > 9, 0.0, rows) * MOVED


def square(rows, d):
    return jacobian(rows).T @ (d[:, None] * jacobian(rows))


@needs_compiler
def test_terms_that_are_known_to_be_zero_are_left_out_of_a_sum():
    kernel = exact.compile_kernel(lambda rows: jacobian(rows).sum(1), ROWS)
    (found,) = by_one_lane(kernel.text, np.where(MOVED, ROWS, np.inf).reshape(1, -1))
    assert (found[0] == [in_turn(r[m]) for r, m in zip(ROWS, MOVED, strict=True)]).all()
    (fold, other) = folds_of(lambda rows: jacobian(rows).sum(1), ROWS)
    assert {(fold.size, fold.terms), (other.size, other.terms)} == {(75, 6), (75, 10)}


@needs_compiler
def test_a_hessian_has_no_terms_that_are_known_to_be_zero_and_one_half(tmp_path):
    d = np.linspace(0.5, 2, 150).astype(np.float32)
    kernel = exact.compile_kernel(square, ROWS, d)
    given = ROWS.reshape(1, -1), d[None]
    (found,), (warps,) = (
        by_one_lane(kernel.text, *given),
        by_warps(kernel.text, *given, folder=tmp_path, environments=1, warps=5),
    )
    assert (found.view(np.int32) == warps.view(np.int32)).all()
    assert np.allclose(found.reshape(64, 64), square(ROWS, d), 1e-4, 1e-5)
    assert (found.reshape(64, 64) == found.reshape(64, 64).T).all()
    terms = sum(x.arg.size for x in folds_of(square, ROWS, d))
    both = (MOVED[:, :, None] & MOVED[:, None, :]).sum()
    assert both / 2 < terms < 0.9 * both, "each term once, and not above the diagonal"


# Of 20 columns three are of all rows; six are of every other, or of the last 60 alone; one of none.
SOME = np.ones((150, 20), bool)
SOME[1::2, 3:9], SOME[:90, 9:15], SOME[:, 19] = False, False, False
SOME[:, 15:19] = np.random.default_rng(3).random((150, 4)) < 0.2


@needs_compiler
def test_lanes_leave_out_known_zeros_and_have_the_bits_of_the_whole_sums(tmp_path):
    j = np.where(SOME, ROWS[:, :20], 0)
    known = lambda j, d: ((j * SOME).T @ (d[:, None] * (j * SOME)), (j * SOME)[:, 2:].sum(0))  # noqa: E731
    whole = lambda j, d: (j.T @ (d[:, None] * j), j[:, 2:].sum(0))  # noqa: E731
    given = j.reshape(1, -1), np.linspace(0.5, 2, 150, dtype=np.float32)[None]
    texts = [exact.compile_kernel(f, j, given[1][0]).text for f in (known, whole)]
    found, wanted = (by_one_lane(text, *given) for text in texts)
    warps = by_warps(texts[0], *given, folder=tmp_path, environments=1, warps=2)
    for one, other, third in zip(found, wanted, warps, strict=True):
        assert (one == other).all() and (one.view(np.int32) == third.view(np.int32)).all()
    rounds = [rounds_of(text.body) for text in texts]
    assert rounds[0] < 0.6 * rounds[1], rounds


def rounds_of(body):
    """Returns how many terms the busiest lane adds to sums, in all."""
    loops = re.findall(r"LANES\(i, (\d+), (\d+)\) (.*)", body)
    return sum(-(-(int(end) - int(first)) // 32) * text.count("SUM(") // 2
               for first, end, text in loops)  # fmt: skip


@pytest.mark.parametrize("share", [0, 0.02, 0.3, 0.9, 1])
def test_each_lane_adds_its_own_terms_in_their_order(share):
    needed = np.random.default_rng(2).random((40, 150)) < share
    needed[:8, 100:] = needed[:8, :40] = False
    for row, terms in zip(needed, lanes.terms_of(~needed), strict=True):
        line = len(terms) and (np.diff(terms) == 1).all()
        lane = (terms if line else np.arange(len(terms))) % 32
        for number in range(32):
            own = [term for term in terms[lane == number] if row[term]]
            assert own == [*np.flatnonzero(row[number::32]) * 32 + number]
        assert -(-len(terms) // 32) <= max(0, *(np.ceil(row[i::32].sum() / 0.6) for i in range(32)))


def test_known_zeros_are_zeros_and_all_that_are_to_be_found():
    x, mask = ROWS[:6, :6], np.tri(6, dtype=np.float32)

    def function(x):
        y = x * mask
        return {
            "mul": y * x.T, "add": y + (y @ x) * mask.T * mask, "sub": -y - y, "sum": y.sum(0)[1:],
            "select": jnp.where(x > 0, y, 2 * y), "view": jnp.concatenate([y[::-1], x]),
            "sin": jnp.sin(y), "cos": jnp.cos(y), "div": y / x, "minus": y - x * mask.T,
        }  # fmt: skip

    program = reading.read(jax.make_jaxpr(function)(x))
    above = int((mask == 0).sum())
    wanted = dict.fromkeys(function(x), above) | {"sum": 0, "cos": 0, "minus": 0, "div": 0}
    for (name, real), value in zip(sorted(function(x).items()), program.outputs, strict=True):
        zero = program.zeros.of(value)
        assert not np.ravel(real)[zero].any() and zero.sum() == wanted[name], name


def folds_of(function, *example):
    program = reading.read(jax.make_jaxpr(function)(*example))
    return [x for x in program.block.items if isinstance(x, values.Fold)]


J = np.ones((40, 6), np.float32)


def of_parts(j, d):
    rows = jnp.concatenate([j[:9], 2 * j[9:]])
    return jnp.einsum("ki,k,kj->ij", rows, d, rows)


@pytest.mark.parametrize(
    "rows, function",
    [
        (21, lambda j, d: j.T @ (d[:, None] * j)),
        (21, of_parts),
        (36, lambda j, d: j.T @ (d[:, None] * jnp.sin(j))),
        (36, lambda j, d: j.T @ (d[:, None] + j)),
        (18, lambda j, d: j[:, :3].T @ (j * d[:, None])),
    ],
)
def test_a_square_of_sums_is_halved_where_it_is_symmetric(rows, function):
    (fold,) = folds_of(function, J, J[:, 0])
    assert fold.size == rows and fold.shared == (rows == 21)
