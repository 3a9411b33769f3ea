"""Cholesky factors and triangular solves of small matrices on a GPU, each as one kernel.

MJX factorises a matrix [nv, nv] for each environment and solves with it, several times in a physics
step. JAX calls cuSOLVER and cuBLAS for that. Each call makes four launches, outside of CUDA graphs;
of an ant's physics step of 0.50 ms they took 0.19. In these kernels, written in Pallas, each warp
takes one matrix and keeps it in registers (measured: `lab/2026-11-22-fewer-kernels.md`).

Of a matrix [n, n] a warp works on [m, m], where m is the least power of 2 that is not below n, and
at least 4. Beyond n it reads an identity.
"""

import functools
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.extend import core

from purerl.exact import pallas_calls

# Rows: a warp has registers for no more. A factor and two solves of 4,096 systems, here and by the
# library: of 14 rows 31 and 86 microseconds; of 27 rows 75 and 170 (H100).
LARGEST = 32


def wanted(eqn: core.JaxprEqn) -> bool:
    """Tells whether an equation is a factorisation or a solve to be computed by these kernels."""
    name = eqn.primitive.name
    if name not in ("cholesky", "triangular_solve"):
        return False
    matrix, *sides = [cast(Any, v.aval) for v in eqn.invars]
    small = matrix.ndim == 2 and 0 < matrix.shape[0] <= LARGEST and matrix.dtype == jnp.float32
    if name == "cholesky":
        return small
    plain = eqn.params["left_side"] and not eqn.params["unit_diagonal"]
    return small and plain and sides[0].shape[1] == 1


def compute(eqn: core.JaxprEqn, platform: str, matrix: Array, *sides: Array) -> list[Array]:
    """Computes an equation that is `wanted`, by a kernel for a platform.

    Args:
      eqn: a Cholesky factorisation, which reads the lower half of the matrix, or a solve.
      platform: the platform to run on.
      matrix: [n, n], symmetric or triangular.
      *sides: of a solve the right-hand side, [n, 1].

    Returns:
      The factor [n, n], NaN from the first pivot on that is not positive; or the solution [n, 1].
    """
    m, p = max(4, 1 << (len(matrix) - 1).bit_length()), eqn.params
    if not sides:
        kernel, inputs = functools.partial(_cholesky_kernel, m), [matrix]
    else:  # conjugate_a changes nothing of real numbers
        kernel = functools.partial(_solve_kernel, p["lower"], p["transpose_a"], m)
        inputs = [matrix, sides[0][:, 0]]
    result = jax.ShapeDtypeStruct(inputs[-1].shape, jnp.float32)
    (found,) = pallas_calls.call(kernel, [result], *inputs, platform=platform)
    return [found[:, None] if sides else found]


def _places(m: int) -> tuple[Array, Array]:
    """Returns the row and the column of each entry, [m, m]."""
    row, col = (lax.broadcasted_iota(jnp.int32, (m, m), axis) for axis in (0, 1))
    return row, col


def _read(ref: Any, row: Array, col: Array) -> Array:
    """Returns entries of a matrix [n, n], beyond them those of an identity."""
    n = ref.shape[0]
    values = ref[jnp.minimum(row, n - 1), jnp.minimum(col, n - 1)]
    return jnp.where((row < n) & (col < n), values, jnp.where(row == col, 1.0, 0.0))


def _write(ref: Any, values: Array, *place: Array) -> None:
    """Writes the entries that are within."""
    from jax.experimental.pallas import triton

    inside = functools.reduce(jnp.logical_and, [x < ref.shape[0] for x in place])
    triton.store(ref.at[place], values, mask=inside)


def _cholesky_kernel(m: int, matrix_ref: Any, factor_ref: Any) -> None:
    """Makes column k of L, and takes its products from the entries to the right, for all k."""
    row, col = _places(m)
    number = lax.iota(jnp.int32, m)

    def step(k: Array, a: Array) -> Array:
        # What is left is symmetric: a column is read as a row, whose sum is within a thread.
        column = jnp.sum(jnp.where(row == k, a, 0.0), axis=0)
        pivot = jnp.sum(jnp.where(number == k, column, 0.0))
        column = column / jnp.where(pivot > 0.0, jnp.sqrt(pivot), jnp.nan)
        down, across = column[:, None], column[None, :]
        rest = jnp.where((row > k) & (col > k), a - down * across, a)
        return jnp.where((row >= k) & (col == k), down, rest)

    a = _read(matrix_ref, jnp.maximum(row, col), jnp.minimum(row, col))
    a = lax.fori_loop(0, matrix_ref.shape[0], step, a)
    _write(factor_ref, jnp.where(row >= col, a, 0.0), row, col)


def _solve_kernel(
    lower: bool, transposed: bool, m: int, matrix_ref: Any, side_ref: Any, solution_ref: Any
) -> None:
    """Solves for x[k] and takes its products from the equations still to solve, for all k."""
    n = matrix_ref.shape[0]
    number = lax.iota(jnp.int32, m)
    row, col = _places(m)
    # Row k of what is read holds the coefficients of x[k]: their sum is within a thread.
    a = _read(matrix_ref, row, col) if transposed else _read(matrix_ref, col, row)
    forward = lower != transposed

    def step(i: Array, x: Array) -> Array:
        k = i if forward else n - 1 - i
        column = jnp.sum(jnp.where(row == k, a, 0.0), axis=0)
        found = jnp.sum(jnp.where(number == k, x, 0.0))
        found = found / jnp.sum(jnp.where(number == k, column, 0.0))
        left = number > k if forward else number < k
        return jnp.where(number == k, found, jnp.where(left, x - column * found, x))

    x = jnp.where(number < n, side_ref[jnp.minimum(number, n - 1)], 0.0)
    _write(solution_ref, lax.fori_loop(0, n, step, x), number)
