"""What is computed with numpy while tracing is what XLA computes."""

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from jax import lax

from purerl.exact import constants
from purerl.exact.traces import evaluate
from tests.exact import rewritten

few = hypothesis.settings(max_examples=8, deadline=None, derandomize=True)
DTYPES = ("int32", "int8", "uint32")
TRUTH = ("bool", "int32")
TO_ANOTHER = {"int32": jnp.uint8, "int8": jnp.int32, "uint32": jnp.int8}


def some(draw, dtype, shape=None):
    """Draws an array; the least and the greatest numbers are likely."""
    sizes = arrays.array_shapes(min_dims=1, max_dims=3, max_side=3)
    return draw(arrays.arrays(dtype, sizes if shape is None else st.just(shape)))


def two(function, dtypes=DTYPES):
    """An operation of two arrays of one shape."""

    def make(draw):
        x = some(draw, draw(st.sampled_from(dtypes)))
        return function, (x, some(draw, x.dtype, x.shape))

    return make


def one(function, dtypes=DTYPES):
    """An operation of one array, made for it by `function(draw, x)`."""

    def make(draw):
        x = some(draw, draw(st.sampled_from(dtypes)))
        return function(draw, x), (x,)

    return make


def broadcast(draw, x):
    shape = [*x.shape]
    places = sorted(draw(st.permutations(range(x.ndim + 1)))[: x.ndim])
    shape.insert(next(i for i in range(x.ndim + 1) if i not in places), 2)
    shape = [3 if n == 1 and draw(st.booleans()) else n for n in shape]
    return lambda y: lax.broadcast_in_dim(y, shape, places)


def cut(draw, x):
    starts = [draw(st.integers(0, n - 1)) for n in x.shape]
    ends = [draw(st.integers(a, n)) for a, n in zip(starts, x.shape, strict=True)]
    strides = draw(st.none() | st.just([draw(st.integers(1, 3)) for _ in x.shape]))
    return lambda y: lax.slice(y, starts, ends, strides)


def cumulate(draw, x):
    axis, reverse = draw(st.integers(0, x.ndim - 1)), draw(st.booleans())
    return lambda y: lax.cumsum(y, axis, reverse=reverse)


def count(draw, x):
    axis = draw(st.integers(0, x.ndim - 1))
    return lambda y: lax.broadcasted_iota(y.dtype, y.shape, axis)


def choose(draw):
    """Of two by truth, or of three by number."""
    a = some(draw, "int32")
    number = draw(st.sampled_from([2, 3]))
    which = np.asarray(some(draw, "uint8", a.shape) % number, "bool" if number == 2 else "int32")
    return lax.select_n, (which, *(some(draw, "int32", a.shape) for _ in range(number)))


def glue(draw, x):
    axis = draw(st.integers(0, x.ndim - 1))
    return lambda y: lax.concatenate([y, y, y], axis)


OPERATIONS = {
    **{name: two(getattr(lax, name)) for name in ("add", "sub", "mul", "max", "min", "rem")},
    **{name: two(getattr(lax, name)) for name in ("lt", "le", "gt", "ge", "eq", "ne")},
    "and": two(lax.bitwise_and, TRUTH),
    "or": two(lax.bitwise_or, TRUTH),
    "not": one(lambda draw, x: lax.bitwise_not, TRUTH),
    "neg": one(lambda draw, x: lax.neg),
    "sign": one(lambda draw, x: lax.sign),
    "broadcast_in_dim": one(broadcast),
    "slice": one(cut),
    "select_n": choose,
    "iota": one(count),
    "cumsum": one(cumulate),
    "reshape": one(lambda draw, x: lambda y: lax.reshape(y, (x.size // x.shape[0], x.shape[0]))),
    "convert_element_type": one(lambda draw, x: lambda y: lax.convert_element_type(
        y, TO_ANOTHER[x.dtype.name])),
    "squeeze": one(lambda draw, x: lambda y: lax.squeeze(
        y, [i for i, n in enumerate(x.shape) if n == 1])),
    "transpose": one(lambda draw, x, : (lambda order: lambda y: lax.transpose(y, order))(
        draw(st.permutations(range(x.ndim))))),
    "concatenate": one(glue),
}  # fmt: skip


@pytest.mark.parametrize("name", OPERATIONS)
@few
@hypothesis.given(data=st.data())
def test_a_rule_computes_what_xla_computes(name, data):
    function, inputs = OPERATIONS[name](data.draw)
    closed = jax.make_jaxpr(function)(*inputs)
    if not closed.jaxpr.eqns:  # nothing to squeeze, no other order
        return
    assert [eqn.primitive.name for eqn in closed.jaxpr.eqns] == [name]
    (found,) = evaluate(closed, constants._compute, np.asarray, *inputs)
    expected = function(*map(jnp.asarray, inputs))
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == expected.dtype


def test_every_rule_is_tested():
    assert set(OPERATIONS) == set(constants._RULES)


X = np.array([[3, -7, 0], [-(2**31), 2**31 - 1, 5]], np.int32)
BY_JAX = {
    "gather": lambda x: x[jnp.array([1, 0, 1])],
    "scatter-add": lambda x: x.at[jnp.array([0, 0])].add(1),
    "sort": lambda x: jnp.sort(x, axis=1),
}
WITH_NUMPY = {
    "a chain": lambda x: jnp.where(x > 0, -x + x * x, lax.rem(x, x.T.reshape(2, 3) | 1)),
    "a function called": lambda x: jax.jit(lambda y: jnp.sign(y) * 4)(x) + 3,
}


@pytest.mark.parametrize("name", [*WITH_NUMPY, *BY_JAX])
def test_jax_is_asked_only_where_there_is_no_rule(monkeypatch, name):
    """JAX would compile a small program for each shape."""
    function = (WITH_NUMPY | BY_JAX)[name]
    asked = []
    by_jax = constants.bind_equation
    monkeypatch.setattr(constants, "bind_equation", lambda *x: asked.append(x) or by_jax(*x))
    (found,) = evaluate(jax.make_jaxpr(function)(X), constants._compute, np.asarray, X)
    expected = jax.jit(function)(X)
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == expected.dtype
    assert bool(asked) == (name in BY_JAX)


def indices(x):
    """Integer arithmetic on constants of every kind that MJX has, and gathers where it leads."""
    i = jnp.arange(-6, 6)
    parts = [i % 4, i // 4, jnp.where(i > 2, i, -i), jnp.clip(i, -1, 3), jax.lax.rem(i, 4)]
    parts += [jnp.concatenate([i[::3], i[2:4]]), i.reshape(3, 4).T[1], i[None].repeat(2, 0)[0]]
    parts += [jnp.minimum(i, 2) * jnp.sign(i), jnp.invert(i), (i == 2) | ~(i < 0), i.astype(bool)]
    parts += [jnp.cumsum(i), jnp.zeros(4, jnp.int32).at[np.array([1, 1, 3])].add(2), jnp.abs(i)]
    return [(part, x[part.astype(jnp.int32)]) for part in parts]


def test_known_integers_are_computed_before_the_program_runs():
    def both(x):  # the sum makes the rewriting enter a loop, whose body knows the integers too
        loop = jax.lax.fori_loop(0, 2, lambda i, c: c.at[np.array([0, 0])].add(1.0), x)
        return indices(x), indices(loop)

    x = jax.random.uniform(jax.random.key(0), (8,))
    closed = rewritten(both, x)
    found = jax.extend.core.jaxpr_as_fun(closed)(x)
    for got, want in zip(found, jax.tree.leaves(both(x)), strict=True):
        assert got.dtype == want.dtype
        np.testing.assert_array_equal(got, want)
    names = {eqn.primitive.name for eqn in closed.jaxpr.eqns}
    assert not names & {"rem", "select_n", "cumsum", "lt"}, "left for the compiler"
