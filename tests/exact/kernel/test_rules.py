"""Each rule against JAX, on small functions: all of them are one kernel, compiled once."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from purerl import exact
from purerl.exact.kernel import compiling, operations
from tests import quick
from tests.exact.kernel import by_one_lane, by_warps, needs_compiler, rows

N = 3  # environments
SQUARE = np.eye(4, dtype=np.float32) * 3
INDEX = np.array([2, 0, 2, 1])
PIECES = [(0, 0), (1, 2), (3, 1)]


def real(*shape, seed=0):
    return np.random.default_rng([seed, *shape]).normal(size=(N, *shape)).astype(np.float32)


def whole(*shape, least=-5, most=6):
    return np.random.default_rng([1, *shape]).integers(least, most, (N, *shape)).astype(np.int32)


def positive(*shape):
    return np.abs(real(*shape)) + 0.1


def with_nan(*shape):
    x = real(*shape)
    x[1].flat[2] = np.nan
    return x


def factors(a):
    return jnp.linalg.cholesky(a @ a.T + SQUARE)


def solves(a, b):
    square = a @ a.T + SQUARE
    cho = jax.scipy.linalg.cho_solve
    solve = functools.partial(lax.linalg.triangular_solve, jnp.linalg.cholesky(square), b[:, None])
    return (
        cho(jax.scipy.linalg.cho_factor(square), b),
        cho(jax.scipy.linalg.cho_factor(square, lower=True), b),
        solve(left_side=True, lower=True, transpose_a=True),
        lax.linalg.triangular_solve(jnp.triu(a) + SQUARE, jnp.stack([b, 2 * b], 1), left_side=True),
        lax.linalg.triangular_solve(
            jnp.asarray(SQUARE + 1.0), b[:, None], left_side=True, lower=True
        ),
    )


def wide(x):
    """More columns than a warp has lanes."""
    y = x.reshape(40, 10)
    factor = jax.scipy.linalg.cho_factor(y @ y.T + 20 * np.eye(40, dtype=np.float32))
    return jnp.tril(factor[0]), jax.scipy.linalg.cho_solve(factor, x[:40])


def newton(x):
    """Ends after other numbers of rounds for each environment."""
    going = lambda c: (c[1] ** 2 - x[0] ** 2 > 1e-3).any() & (c[0] < 20)  # noqa: E731
    return lax.while_loop(
        going, lambda c: (c[0] + 1, (c[1] + x[0] ** 2 / c[1]) / 2), (0, 9 + x[0] ** 2)
    )


def swapped(x):
    """A carry whose parts change places or are turned round, and one that stays."""
    changed = lax.fori_loop(0, 5, lambda i, c: (c[1] + i, c[0] * 0.5, c[2]), (x, x + 1, 2 * x))
    return changed, lax.fori_loop(0, 3, lambda i, c: (c[1], c[0], c[2][::-1]), (x, x + 1, 2 * x))


def reused(x):
    """Memory of what each round reads, or carries unchanged, is not taken in between."""
    y = jnp.sin(x)

    def body(_, c):
        a = jnp.sort(c[0] + y)
        b = jnp.sort(a[::-1] * a)
        return jnp.sort(b + a.sum()) * 0.1, c[1]

    return lax.fori_loop(0, 3, body, (x, jnp.cos(x)))


def in_rounds(x):
    both = lax.scan(lambda c, r: (c + r, c * r), jnp.zeros(4), x.reshape(3, 4), reverse=True)
    return both, lax.scan(lambda c, _: (jnp.sin(c), None), x, None, 3)[0]


def nested(x):
    def inner(c):
        return lax.while_loop(lambda y: y[1] < 3, lambda y: (y[0] * 0.9 + x, y[1] + 1), (c, 0))[0]

    return lax.fori_loop(0, 3, lambda _, c: inner(c) - c.mean(), x)


def branches(x, i):
    two = lax.cond(x[0] > 0, lambda: jnp.sin(x), lambda: jnp.stack([x.sum()] * 4))
    return (
        two,
        lax.switch(i[0], [lambda: x, lambda: 2 * x, lambda: x[::-1]]),
        lax.switch(1, [lambda: x] * 2),
    )


def moved(x):
    parts = [
        x.T,
        x[::-1, 1:3],
        x[None, ..., None],
        lax.pad(x, jnp.float32(7), ((1, 2, 0), (0, -1, 0))),
    ]
    parts += [jnp.tile(x, (2, 1)), jnp.concatenate([x, 0 * x[:1], x[:2]]), jnp.stack([x, x + 1], 1)]
    parts += [
        *jnp.split(x, 3),
        *lax.unstack(x, axis=1),
        jnp.broadcast_to(x[0], (3, 4)),
        x.reshape(2, 6),
        x[::2],
    ]
    return parts


def put(x, y):
    added = jnp.zeros(3).at[INDEX].add(x)
    parts = [x.at[jnp.array([1, 3])].set(y[:2]), x.at[0].multiply(y[0]), added]
    return [*parts, jnp.zeros((4, 5)).at[jnp.arange(4), INDEX].set(x), x.at[np.array([9])].add(1.0)]


def looked_up(x, i):
    table = jnp.asarray(np.arange(20.0, dtype=np.float32).reshape(5, 4)) ** 2
    parts = [x[i], table[i, 1], x.reshape(2, 5)[i % 2], jnp.take(x, i, mode="clip"), x[:3][i]]
    parts += [jnp.take(x, 2 * i, mode="fill"), jnp.take(x, i + 9, mode="fill", fill_value=4.0)]
    parts += [lax.dynamic_slice(x, (i[0],), (3,)), lax.dynamic_slice(table, (i[1], i[2]), (2, 2))]
    parts += [
        jax.vmap(lambda r, k: r[k])(table, i),
    ]
    return [*parts, x[INDEX], x.reshape(5, 2)[INDEX, 1]]


def chosen(x, i):
    """Of wide maps a few numbers; of stacks, in no line, many alike, and out of bounds."""
    table = jnp.sin(x[:40].reshape(8, 5, 1) + np.arange(1, 13, dtype=np.float32) * x[0])
    whole = jnp.stack([jnp.cross(table[..., k : k + 3], x[:3]) for k in range(2)], 1)
    size = jnp.sqrt((whole**2).sum(-1, keepdims=True))
    alike = jnp.exp(x[40:52].reshape(1, 12) * jnp.ones((9, 1))) / jnp.exp(x[:9].sum())
    best = jnp.abs(size[..., 0]).argmin(-1)
    parts = [jax.vmap(jax.vmap(lambda row, k: row[k]))(whole / size, best), (whole / size)[i[0]]]
    parts += [jnp.take(jnp.cos(table[:, INDEX]), i, axis=1, mode="clip"), alike, alike[i]]
    parts += [
        jnp.take(jnp.cos(table), 3 * i, axis=0, mode="fill", fill_value=2.0),
        table[i, i],
        x[INDEX][i],
    ]
    uneven = jnp.concatenate([jnp.sin(x), jnp.tile(jnp.cos(x), 2)]) * x[0]  # no stack of maps
    stack = jnp.stack([0.5 * x * x, x[0] * x, jnp.tanh(x)]) * x[::-1]
    signs = np.array([0.0, -0.0] * 50, np.float32)
    parts += [jnp.sin(stack) + stack[::-1], uneven, stack.sum(1), x[2] / signs]
    return [*parts, lax.fori_loop(0, 3, lambda k, c: jnp.cos(c[:, None] * x)[:, k + i[0]], x[:20])]


def ordered(x, i):
    pairs = lax.sort((i, x), num_keys=2)
    return [
        jnp.sort(x),
        jnp.argsort(x),
        jnp.sort(x.reshape(2, 5), 0),
        *pairs,
        jnp.argsort(i),
    ]


def sums(x):
    y = x.reshape(40, 10)
    parts = [y.sum(0), y.sum(1), y.sum(), (y * y).sum(0), y.max(0), y.min(), y.prod(1), x[:3].sum()]
    parts += [y.argmax(0), y.argmin(1), (y > 0).all(0), (y > 1.5).any(1), y.mean((0, 1))]
    parts += [
        jnp.cumsum(x[:7]),
        lax.cumsum(x[:6].reshape(2, 3), 1, reverse=True),
    ]
    return [*parts, (y[:, 0] > 0).sum(), y[:0].sum(0), y[:, :5].max(1)]


def products(x, y):
    hessian = jnp.einsum("ki,k,kj->ij", y, x[:40] ** 2, y)
    square = jnp.einsum("ki,kj->ij", y, jnp.sin(y))  # not symmetric
    parts = [
        y @ y.T,
        y.T @ y,
        hessian,
        square,
        jnp.einsum("bij,bj->bi", y.reshape(4, 10, 10), y[:4]),
    ]
    return [*parts, jnp.dot(x[:10], x[10:20]), jnp.cross(x[:3], x[3:6]), y @ x[:10]]


def numbers(x, y):
    """One function that has one result for each elementwise operation."""
    parts = [x + y, x - y, x * y, x / y, -x, abs(x), jnp.maximum(x, y), jnp.minimum(x, y)]
    parts += [
        jnp.sign(x),
        jnp.floor(x),
        jnp.ceil(x),
        jnp.round(x),
        x**2,
        x**3,
        x**-2,
        jnp.square(x),
    ]
    parts += [f(x) for f in (jnp.sin, jnp.cos, jnp.tan, jnp.arctan, jnp.sinh, jnp.cosh, jnp.tanh)]
    parts += [f(x) for f in (jnp.exp, jnp.exp2, jnp.expm1, jax.nn.sigmoid, jnp.cbrt)]
    parts += [f(abs(x)) for f in (jnp.sqrt, lax.rsqrt, jnp.log, jnp.log1p)]
    parts += [f(jnp.tanh(x)) for f in (jnp.arcsin, jnp.arccos)]
    parts += [
        jnp.arctan2(x, y),
        abs(x) ** y,
        lax.rem(x, y),
        x < y,
        x <= y,
        x > y,
        x >= y,
        x == y,
        x != y,
    ]
    parts += [jnp.isfinite(x / (y - y)), jnp.where(x > 0, x, y), jnp.clip(x, -0.5, 0.5)]
    return [
        *parts,
        lax.select_n(jnp.int32(x > 0) + jnp.int32(x > 1), x, y, x + y),
        x.astype(jnp.int32),
    ]


def integers(i, j):
    a, b = i > 0, j > 0
    parts = [
        a & b,
        a | b,
        a ^ b,
        ~a,
        i & j,
        i | j,
        ~i,
        i * j,
        i - j,
        lax.rem(i, j),
        lax.div(i, jnp.int32(3)),
    ]
    return [
        *parts,
        abs(i),
        jnp.sign(i),
        i.astype(jnp.float32),
        a.astype(jnp.int32),
        i.max(),
        i.sum(),
    ]


def known(x):
    """Nothing but constants, in part: computed before the kernel runs."""
    a = jnp.arange(6.0)
    parts = [
        jnp.sin(a),
        a @ a,
        jnp.sort(a[::-1]),
        a**0.5,
        (a > 2).sum(),
        a / 3,
        7 // jnp.arange(1, 4),
    ]
    return [*parts, x * 0, x * 1 + 0, jnp.where(a > 2, x[:6], x[1:7]), jnp.zeros(0), x[:0] * 2]


def drawn(x):
    """Expressions drawn at random, of values [4, 4] that read each other in every way."""
    rng, values = np.random.default_rng(0), [x, x.T, x + 1]
    steps = [
        lambda a, b: a * b,
        lambda a, b: a - b.T,
        lambda a, b: jnp.sin(a) + b[0],
        lambda a, b: jnp.tanh(a @ b),
        lambda a, b: a[INDEX],
        lambda a, b: jnp.where(a > b, a, b[::-1]),
        lambda a, b: a.at[1:3, INDEX[:2]].set(b[:2, :2]),
        lambda a, b: jnp.concatenate([a[:1], b[:2], a[2:3]]),
        lambda a, b: a - a.mean(1) + b.max(0)[:, None],
        lambda a, b: lax.fori_loop(0, 3, lambda i, c: jnp.tanh(c * 0.5 + b), a),
        lambda a, b: lax.cond(a[0, 0] > b[1, 1], lambda: a * 0.5, lambda: b.T),
        lambda a, b: jnp.sort(a, 0) * 0.5,
    ]
    for _ in range(60):
        a, b = (values[-1 - min(int(rng.exponential(3.0)), len(values) - 1)] for _ in "ab")
        values.append(steps[rng.integers(len(steps))](a, b))
    return values[-20:]


FUNCTIONS = {
    "branches": (branches, real(4), whole(1)),
    "chosen": (chosen, real(100), whole(5, least=0, most=5)),
    "drawn": (drawn, real(4, 4)),
    "factors": (factors, real(4, 4)),
    "in_rounds": (in_rounds, real(12)),
    "integers": (integers, whole(30), whole(30)),
    "known": (known, real(7)),
    "looked_up": (looked_up, real(10), whole(5, least=0, most=5)),
    "moved": (moved, real(3, 4)),
    "nan_first": (
        lambda x: (x.argmax(), x.max(), jnp.sort(x), x.argmin()),
        with_nan(7),
    ),
    "nested": (nested, real(4)),
    "newton": (newton, real(6)),
    "numbers": (numbers, real(40), real(40, seed=1)),
    "ordered": (ordered, real(10), whole(10)),
    "products": (products, real(40), real(40, 10)),
    "put": (put, real(4), real(4, seed=1)),
    "reused": (reused, real(9)),
    "solves": (solves, real(4, 4), real(4)),
    "sums": (sums, real(400)),
    "wide": (wide, real(400)),
    "swapped": (swapped, real(4)),
    "truth": (lambda b: (b, ~b, b.any()), whole(5) > 0),
}
INEXACT = 2e-5  # functions of the C library and of XLA, and sums in other orders


def all_of_them(inputs):
    return {name: function(*inputs[name]) for name, (function, *_) in FUNCTIONS.items()}


INPUTS = {name: tuple(args) for name, (_, *args) in FUNCTIONS.items()}


@pytest.fixture(scope="module")
def kernel():
    return exact.compile_kernel(all_of_them, jax.tree.map(lambda x: x[0], INPUTS))


@pytest.fixture(scope="module")
def results(kernel):
    """What the kernel and JAX compute."""
    return [jax.tree.map(np.asarray, quick.jit(jax.vmap(f))(INPUTS)) for f in (kernel, all_of_them)]


@needs_compiler
@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_kernel_computes_what_jax_does(results, name):
    found, wanted = (x[name] for x in results)
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for number, (x, y) in enumerate(
        zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True)
    ):
        assert x.shape == y.shape and x.dtype == y.dtype, number
        close = (
            np.allclose(x, y, INEXACT, INEXACT, equal_nan=True)
            if x.dtype.kind == "f"
            else (x == y).all()
        )
        assert close, f"result {number}:\n{x}\nfor\n{y}"


@needs_compiler
@pytest.mark.parametrize("warps, downwards", [(1, False), (1, True), (3, False), (3, True)])
def test_warps_have_the_bits_of_one_lane(kernel, tmp_path, warps, downwards):
    arrays = rows(*map(np.asarray, jax.tree.leaves(INPUTS)))
    one = by_one_lane(kernel.text, *arrays)
    warps = by_warps(kernel.text, *arrays, folder=tmp_path, warps=warps, downwards=downwards)
    for x, y in zip(one, warps, strict=True):
        np.testing.assert_array_equal(x.view(np.int32), y.view(np.int32))


# --- what has no rule ---


def unknown(x, i):
    return x.at[i].set(1.0), lax.population_count(i), jnp.linalg.eigh(x[:4].reshape(2, 2))[0]


def test_what_has_no_rule_is_named_with_its_line():
    example = np.ones(5, np.float32), np.zeros(2, np.int32)
    found = exact.kernel_missing(unknown, *example)
    assert {x.primitive for x in found} >= {"scatter", "population_count"}
    assert all("test_rules.py" in one.source for one in found)  # of eigh too, which JAX traces
    (scatter,) = [x for x in found if x.primitive == "scatter"]
    assert "known only while running" in scatter.why
    said = r"No kernel computes scatter of places .* at .*test_rules.py:\d+"
    with pytest.raises(compiling.NoRuleError, match=said):
        exact.compile_kernel(unknown, *example)
    assert not exact.kernel_missing(sums, np.ones(400, np.float32))


def test_numbers_that_no_kernel_has_are_listed():
    def drawn(x):
        return x + jax.random.normal(jax.random.key(0), (3,))

    for f, example, why in (
        (jnp.sin, np.zeros(3, np.float16), "float16"),
        (jnp.sum, np.zeros(3, np.uint32), "uint32"),
        (jax.random.normal, jax.random.key(0), "key<fry>"),
        (drawn, np.zeros(3, np.float32), "key<fry>"),
        (lambda x: x + np.zeros(3, np.float16), np.zeros(3, np.float32), "float16"),
    ):
        assert f"numbers of {why}" in {x.why for x in exact.kernel_missing(f, example)}
        with pytest.raises(compiling.NoRuleError, match=f"of numbers of {why}, traced at "):
            exact.compile_kernel(f, example)


def test_what_a_kernel_cannot_hold_is_refused():
    said = "memory for 90,001 numbers .* leave this step to XLA"
    with pytest.raises(compiling.NoRuleError, match=said):
        exact.compile_kernel(jnp.sum, np.ones(90_000, np.float32))
    with pytest.raises(compiling.NoRuleError, match="uint8"):
        exact.compile_kernel(lambda x: x.astype(jnp.uint8), np.ones(3, np.float32))
    looping = jax.vmap(lambda x: lax.while_loop(lambda y: y < 9, lambda y: y * 2, x))
    with pytest.raises(compiling.NoRuleError, match="a vmapped loop"):
        exact.compile_kernel(looping, np.ones(3, np.float32))


def test_a_remainder_that_is_known_is_xlas_by_zero_too():
    x, y = np.int32([7, -7, 5]), np.int32([0, 3, 2])
    assert operations.computed("rem", "i", None, x, y).tolist() == [7, -1, 1]
