"""Tests for purerl.exact.fused_solves: the GPU's kernels, here interpreted, against LAPACK."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxpr_as_fun

from purerl.exact import fused_solves, pallas_calls
from tests.exact import GPU, named, rewritten

SIZES = (1, 2, 5, 14, 27, 32)


def positive_matrix(n, seed=0):
    half = np.random.default_rng(seed).normal(size=(n, n))
    return (half @ half.T + 0.5 * np.eye(n)).astype(np.float32)


def close(found, exact):
    return np.abs(found - exact).max() < 2e-6 * np.abs(exact).max()


def by_kernel(function):
    """Returns the function as on a GPU, where it is one kernel."""

    def run(*inputs):
        traced = rewritten(function, *inputs, platform=GPU)
        assert len(named(traced, "pallas_call")) == 1
        return jaxpr_as_fun(traced)(*inputs)[0]

    return run


@by_kernel
def factor_of(matrix):
    return jax.lax.linalg.cholesky(matrix, symmetrize_input=False)


def solution(lower, transposed):
    def solve(matrix, side):
        options = {"left_side": True, "lower": lower, "transpose_a": transposed}
        return jax.lax.linalg.triangular_solve(matrix, side[:, None], **options)[:, 0]

    return by_kernel(solve)


@pytest.mark.parametrize("n", SIZES)
def test_the_factor_is_the_one_of_the_lower_half(n):
    matrix = positive_matrix(n)
    other_half = np.triu(np.full((n, n), 99.0, np.float32), 1)
    factor = factor_of(jnp.asarray(matrix + other_half))
    assert close(factor, np.linalg.cholesky(matrix.astype(np.float64)))
    assert (np.triu(factor, 1) == 0.0).all()


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("lower", [False, True])
@pytest.mark.parametrize("transposed", [False, True])
def test_a_solve_reads_the_half_it_is_told_to(n, lower, transposed):
    keep, junk = (np.tril, np.triu) if lower else (np.triu, np.tril)
    matrix = keep(positive_matrix(n) + 3.0 * np.eye(n, dtype=np.float32))
    side = np.random.default_rng(1).normal(size=n).astype(np.float32)
    other_half = junk(np.full((n, n), 99.0, np.float32), 1 if lower else -1)
    found = solution(lower, transposed)(jnp.asarray(matrix + other_half), jnp.asarray(side))
    whole = matrix.T if transposed else matrix
    assert close(found, np.linalg.solve(whole.astype(np.float64), side))


@pytest.mark.parametrize("function, number", [(factor_of, 1), (solution(False, False), 2)])
def test_nothing_is_written_beyond_a_system(function, number):
    """Interpreted, a kernel drops such writes; on a GPU they are in the next system."""
    inputs = (jnp.zeros((5, 5)), jnp.zeros(5))[:number]
    (call,) = named(jax.make_jaxpr(function)(*inputs), "pallas_call")
    (write,) = [e for e in call.params["jaxpr"].eqns if e.primitive.name == "masked_swap"]
    assert write.invars[-1].aval.dtype == bool, "no mask"


@pytest.mark.parametrize("pivot", [0.0, -1.0, np.nan])
def test_a_bad_pivot_gives_no_number(pivot):
    matrix = np.diag([4.0, 1.0, pivot, 1.0]).astype(np.float32)
    matrix[3, 2] = 1.0  # by a pivot of 0 it would be infinite
    factor = np.asarray(factor_of(jnp.asarray(matrix)))
    assert factor[0, 0] == 2.0 and factor[1, 1] == 1.0
    assert np.isnan(factor[2:, 2]).all() and np.isnan(factor[3, 3])


def solve(matrix, side):
    """As MJX does for its mass matrix and its Newton step."""
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), side)


def solve_in_a_loop(matrix, side):
    return jax.lax.scan(lambda x, _: (solve(matrix, x), x), side, None, 3)[0]


@pytest.mark.parametrize("function", [solve, solve_in_a_loop])
def test_on_a_gpu_the_trace_of_small_systems_has_their_kernels(function):
    sizes = jnp.zeros((7, 7)), jnp.zeros(7)
    plain = str(rewritten(function, *sizes))
    assert "cholesky" in plain and "pallas_call" not in plain
    traced = rewritten(function, *sizes, platform=GPU)
    assert "pallas_call" in str(traced) and "cholesky" not in str(traced.jaxpr.eqns)
    run = jax.vmap(jaxpr_as_fun(traced))
    matrices = np.stack([positive_matrix(7, seed) for seed in range(3)])
    sides = np.random.default_rng(1).normal(size=(3, 7)).astype(np.float32)
    (found,) = run(matrices, sides)
    for one, matrix, side in zip(found, matrices, sides, strict=True):
        assert close(one, np.asarray(function(jnp.asarray(matrix), jnp.asarray(side))))


@pytest.mark.parametrize(
    "function, shapes",
    [
        (jnp.linalg.cholesky, [(fused_solves.LARGEST + 1,) * 2]),
        (solve, [(fused_solves.LARGEST + 1,) * 2, (fused_solves.LARGEST + 1,)]),
    ],
)
def test_larger_systems_are_left_to_the_library(function, shapes):
    assert "pallas_call" not in str(rewritten(function, *map(jnp.zeros, shapes), platform=GPU))


def test_several_right_hand_sides_are_left_to_the_library():
    traced = rewritten(
        lambda a, b: jax.lax.linalg.triangular_solve(a, b, left_side=True, lower=True),
        jnp.zeros((4, 4)), jnp.zeros((4, 2)), platform=GPU,
    )  # fmt: skip
    assert "pallas_call" not in str(traced)


def test_a_system_inside_of_what_cannot_be_rewritten_is_left_to_the_library():
    def function(matrix, side):
        return jax.lax.custom_linear_solve(
            lambda x: matrix @ x, side, lambda _, b: solve(matrix, b), symmetric=True
        )

    matrix, side = positive_matrix(4), np.ones(4, np.float32)
    traced = rewritten(function, matrix, side, platform=GPU)
    assert "cholesky" in str(traced)
    (found,) = jaxpr_as_fun(traced)(matrix, side)
    assert close(found, np.linalg.solve(matrix.astype(np.float64), side))


def test_without_tritons_part_of_pallas_there_are_no_kernels_of_our_own(monkeypatch):
    def gone(name):
        raise ModuleNotFoundError(f"No module named {name}")

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert pallas_calls.can_run()
    monkeypatch.setattr(pallas_calls.importlib.util, "find_spec", gone)
    assert not pallas_calls.can_run()
