"""Programs that call no library: the same values, and the same bits whatever a library thinks."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from jax import lax

from purerl import exact
from purerl.exact import xla_flags
from purerl.exact.portable import LibraryError
from tests.exact import named

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


def numbers(*shape):
    return np.random.default_rng(sum(shape)).normal(size=shape).astype(np.float32)


@st.composite
def products(draw):
    """Two shapes, and which of their axes are summed and which go together, in any order."""
    size = st.integers(1, 4)
    sums, batch = (draw(st.lists(size, max_size=2)) for _ in range(2))
    sides = []
    for _ in range(2):
        free = draw(st.lists(size, max_size=2))
        order = draw(st.permutations(range(len(sums) + len(batch) + len(free))))
        shape = [0] * len(order)
        for axis, length in zip(order, [*sums, *batch, *free], strict=True):
            shape[axis] = length
        sides.append((tuple(shape), order[: len(sums)], order[len(sums) :][: len(batch)]))
    return sides


def test_a_called_function_keeps_the_arrays_that_it_has_captured():
    """Since jax 0.11 such a call's trace has them itself, and is no input of the caller."""
    known, x = jnp.asarray(numbers(3, 4)), numbers(2, 3)
    called = jax.jit(lambda x: x @ known + known[0])
    np.testing.assert_allclose(exact.without_libraries(called)(x), called(x), rtol=1e-5)


@settings(max_examples=30)
@given(products())
def test_any_product_keeps_its_value(sides):
    (left, left_sums, left_batch), (right, right_sums, right_batch) = sides
    axes = (tuple(left_sums), tuple(right_sums)), (tuple(left_batch), tuple(right_batch))
    x, y = numbers(*left), numbers(*right)
    function = lambda x, y: lax.dot_general(x, y, axes)  # noqa: E731
    wanted, found = function(x, y), exact.without_libraries(function)(x, y)
    assert found.shape == wanted.shape and found.dtype == wanted.dtype
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-5)


def test_products_inside_of_loops_and_gradients_are_found():
    """A vmapped `while` has a condition for each; the ones that are over keep their values."""

    def cost(x, w):
        def body(carry):
            i, y = carry
            return i + 1, jnp.tanh(y @ w)

        i, y = lax.while_loop(lambda carry: carry[1].sum() > carry[0], body, (0, x))
        total, _ = lax.scan(lambda c, row: (c + (row @ w).sum(), None), 0.0, jnp.stack([y, y]))
        return total + i

    x, w = numbers(5, 2, 3) + 1, numbers(3, 3)
    every = jax.vmap(cost, in_axes=(0, None))
    np.testing.assert_allclose(exact.without_libraries(every)(x, w), every(x, w), rtol=1e-5)
    slope = jax.grad(lambda w: jnp.tanh(x.reshape(-1, 3) @ w).sum())
    trace = jax.make_jaxpr(exact.without_libraries(slope))(w)
    plain = [(((1,), (0,)), ((), ()))]
    assert {eqn.params["dimension_numbers"] for eqn in named(trace, "dot_general")} == set(plain)
    np.testing.assert_allclose(exact.without_libraries(slope)(w), slope(w), rtol=1e-5)


@settings(max_examples=8)
@given(st.integers(1, 9), st.integers(1, 3), st.lists(st.integers(1, 3), max_size=2), st.data())
def test_factors_and_solutions_are_those_of_the_library(n, m, batch, data):
    half = np.tril(numbers(*batch, n, n)) / n
    matrix = half + np.swapaxes(half, -1, -2) + 4 * np.eye(n, dtype=np.float32)
    cholesky = lambda x: lax.linalg.cholesky(x, symmetrize_input=False)  # noqa: E731
    upper = np.triu(np.full((n, n), np.nan), 1).astype(np.float32)  # is not read
    found = exact.without_libraries(cholesky)(matrix + upper)
    np.testing.assert_allclose(found, cholesky(matrix), rtol=1e-5, atol=1e-5)
    names = ("left_side", "lower", "transpose_a", "unit_diagonal")
    flags = {name: data.draw(st.booleans(), label=name) for name in names}
    sides = numbers(*batch, n, m) if flags["left_side"] else numbers(*batch, m, n)
    solve = lambda a, b: lax.linalg.triangular_solve(a, b, **flags)  # noqa: E731
    found, wanted = exact.without_libraries(solve)(matrix, sides), solve(matrix, sides)
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("shape", [(1, 1), (4, 4), (7, 3), (3, 7), (2, 5, 5), (2, 3, 1, 4)])
@pytest.mark.parametrize("full", [True, False])
def test_an_orthogonal_matrix_is_that_of_the_library(shape, full):
    function = lambda x: lax.linalg.qr(x, full_matrices=full)  # noqa: E731
    x = numbers(*shape)
    x[..., 0] = np.arange(shape[-2]) == 0  # nothing below: LAPACK reflects nothing
    for found, wanted in zip(exact.without_libraries(function)(x), function(x), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5)


def test_a_matrix_that_is_not_positive_has_no_factor():
    matrix = np.diag([1.0, -1.0, 1.0]).astype(np.float32)
    assert np.isnan(exact.without_libraries(jnp.linalg.cholesky)(matrix)).any()


@pytest.mark.parametrize(
    ("function", "named"),
    [
        (lambda x: jax.scipy.linalg.qr(x, pivoting=True)[0], "qr|geqp3"),
        (lambda x: lax.map(jnp.linalg.svd, x[None])[0], "svd"),
        (lambda x: jnp.linalg.solve(x, x[0]), "lu"),
        (lambda x: jnp.linalg.cholesky(x + 1j).real, "cholesky"),
        (lambda x: lax.conv(x[None, None], x[None, None], (1, 1), "SAME"), "conv_general_dilated"),
    ],
)
def test_what_only_a_library_computes_is_named(function, named):
    with pytest.raises(LibraryError, match=f"computes ({named}), .*{Path(__file__).name}:"):
        exact.without_libraries(function)(np.eye(3, dtype=np.float32))


SCRIPT = """
import hashlib
from purerl import exact
exact.set_portable_flags()
import jax, jax.numpy as jnp, numpy as np
draw = lambda *shape: np.random.default_rng(0).normal(size=shape).astype("f")
x, w = draw(999, 60), draw(60, 99)
layers = lambda w: jnp.tanh(jnp.tanh(x @ w) @ w.T) * jax.lax.rsqrt(1 + x * x)
factor = lambda w: jnp.linalg.cholesky(w @ w.T + 9 * jnp.eye(60)) + jnp.linalg.qr(w)[0]
function = jax.value_and_grad(lambda w: factor(w).sum() + layers(w).sum())
squares = lambda x: jnp.square(x).sum(-1)  # LLVM may fuse these
found = [jax.jit(exact.without_libraries(f))(w) for f, w in ((function, w), (squares, x[:, :8]))]
found = jax.tree.leaves(found)
print(hashlib.sha256(b''.join(np.asarray(leaf).tobytes() for leaf in found)).hexdigest())
slopes = jax.grad(lambda w, v: jnp.tanh(jnp.tanh(x @ w) @ v).sum(), (0, 1))
slopes = jax.jit(exact.without_libraries(slopes)).lower(w, draw(99, 5)).compile()
print(*(line for line in slopes.as_text().splitlines() if " dot(" in line), sep="\\n")
"""


def digest(**environment):
    env = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"} | environment
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=env, cwd=ROOT, capture_output=True, text=True
    )
    assert not done.returncode, done.stderr
    return done.stdout


def test_a_library_that_thinks_the_processor_another_changes_no_bit():
    """oneDNN, OpenBLAS, glibc and LLVM choose by the processor, and can be told another one."""
    told = {
        "XLA_FLAGS": "--xla_cpu_prefer_vector_width=128",  # LLVM's, of some models
        "ONEDNN_MAX_CPU_ISA": "SSE41",
        "OPENBLAS_CORETYPE": "Prescott",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-ERMS",
        "NPROC": "7",
    }
    assert digest() == digest(**told)


def test_xla_puts_no_product_together_again_that_eigen_computes():
    """It would compute the transpose of a product, which is each layer's slope, by Eigen."""
    _, *products = digest().splitlines()
    plain = "lhs_contracting_dims={1}, rhs_contracting_dims={0}"
    assert len(products) == 5 and all(plain in line for line in products), products


def test_the_other_flags_stay_and_a_contrary_one_is_named(monkeypatch):
    jax.devices()  # begins here, since it would end the process at a flag that it does not know
    monkeypatch.setenv("NPROC", "9")
    monkeypatch.setenv("XLA_FLAGS", "--xla_a=b --xla_cpu_multi_thread_eigen=false")
    assert not exact.is_portable()
    with pytest.raises(RuntimeError, match="JAX has begun with other flags"):
        exact.set_portable_flags()
    monkeypatch.setattr(xla_flags, "jax_has_begun", lambda: False)
    exact.set_portable_flags()
    assert exact.is_portable() and os.environ["XLA_FLAGS"].startswith("--xla_a=b --xla_cpu_multi")
    once = os.environ["XLA_FLAGS"]
    exact.set_portable_flags()
    assert os.environ["XLA_FLAGS"] == once and once.count("multi_thread_eigen") == 1
    monkeypatch.setenv("NPROC", "2")
    assert not exact.is_portable()
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_max_isa=AVX512")
    with pytest.raises(ValueError, match="has --xla_cpu_max_isa=AVX512; portable bits need --xla_"):
        exact.set_portable_flags()
