"""Are small linear systems right on this GPU, and how fast beside JAX's own library?

python -m tests.long.fused_solves

A row is one size: a Cholesky factor of each of so many systems and the two solves with it, in a
loop of 50. Errors are the greatest of any solution, relative to its greatest entry in float64.
"""

import sys
import time
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from purerl import exact

SIZES = {1: 4096, 3: 4096, 8: 4096, 14: 4096, 16: 4096, 23: 2048, 27: 4096, 32: 4096}
ROUNDS = 50


def library(matrix: Array, side: Array) -> Array:
    """Solves one system by JAX's: cuSOLVER and cuBLAS on a GPU."""
    factor = jax.lax.linalg.cholesky(matrix, symmetrize_input=False)
    solve = partial(jax.lax.linalg.triangular_solve, factor, left_side=True, lower=True)
    return solve(solve(side[:, None]), transpose_a=True)[:, 0]


here = exact.rewrite(library)  # by our kernels


def systems(rows: int, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns matrices [number, rows, rows] and right-hand sides [number, rows], float32."""
    rng = np.random.default_rng(rows)
    half = rng.normal(size=(number, rows, rows))
    matrices = half @ half.transpose(0, 2, 1) + rows * np.eye(rows)
    return matrices.astype(np.float32), rng.normal(size=(number, rows)).astype(np.float32)


def error(solve: Callable, matrices: np.ndarray, sides: np.ndarray) -> float:
    """Returns the greatest relative error of the solutions."""
    found = np.asarray(jax.jit(jax.vmap(solve))(matrices, sides))
    exact = np.linalg.solve(matrices.astype(np.float64), sides[..., None])[..., 0]
    return float((np.abs(found - exact).max(-1) / np.abs(exact).max(-1)).max())


def microseconds(solve: Callable, matrices: np.ndarray, sides: np.ndarray) -> float:
    """Returns the median time of a round; each waits for the one before, as in a physics step."""

    def step(x: Array, _: None) -> tuple[Array, None]:
        # Another matrix each time, or XLA would factorise once.
        return jax.vmap(solve)(matrices + 1e-9 * x[:, :1, None], x) + sides, None

    loop = jax.jit(lambda x: jax.lax.scan(step, x, None, ROUNDS)[0])
    times = []
    for _ in range(6):
        begin = time.perf_counter()
        jax.block_until_ready(loop(sides))
        times.append(time.perf_counter() - begin)
    return float(np.median(times[1:])) / ROUNDS * 1e6  # without the first, which compiles


def main() -> int:
    """Prints the table; exit code 0 if all errors are those of float32."""
    exact.set_xla_flags()
    if jax.default_backend() != "gpu":
        sys.exit("JAX finds no GPU, and on a CPU these kernels are only interpreted.")
    row, right = "{:>4} {:>7} {:>10} {:>10} {:>12} {:>12}", True
    print(row.format("rows", "systems", "here [us]", "JAX [us]", "error here", "of JAX"))
    for rows, number in SIZES.items():
        given = systems(rows, number)
        on_gpu = tuple(map(jnp.asarray, given))
        times = [f"{microseconds(solve, *on_gpu):.0f}" for solve in (here, library)]
        errors = [error(solve, *given) for solve in (here, library)]
        right = right and errors[0] < 1e-5  # not so of NaN
        print(row.format(rows, number, *times, *(f"{e:.1e}" for e in errors)), flush=True)
    return 0 if right else 1


if __name__ == "__main__":
    sys.exit(main())
