"""Kernels of our own, written in Pallas: where they can run, and how they are called."""

import importlib.util
from collections.abc import Callable
from typing import Any

import jax
from jax import Array

AT_ONCE = 32  # arrays that one kernel copies: each takes registers
BLOCK = 128  # entries of each that a warp copies, four a thread
# Programs as for a GPU, whose kernels any device can run, slowly: for tests.
INTERPRETED = "interpreted"
GPUS = ("gpu", INTERPRETED)


def can_run(platform: str | None = None) -> bool:
    """Tells whether a platform (None: JAX's default backend) runs kernels of our own.

    It is a GPU, and JAX has Triton's part of Pallas. JAX means to remove that; then XLA's kernels
    and loops are used.
    """
    try:
        there = importlib.util.find_spec("jax.experimental.pallas.triton") is not None
    except ModuleNotFoundError:  # not even what it is a part of
        there = False
    return there and (platform or jax.default_backend()) in GPUS


def call(
    kernel: Callable[..., None],
    results: list[jax.ShapeDtypeStruct],
    *inputs: Array,
    grid: tuple[int, ...] = (),
    platform: str | None = None,
) -> list[Array]:
    """Runs a kernel in one warp, or in a `grid` of warps; under `vmap`, in as many for each.

    Args:
      kernel: takes a reference to each input, then to each result, and writes the results.
      results: their shapes and dtypes.
      *inputs: the arrays to read.
      grid: number of warps along each axis; `pallas.program_id` tells a kernel which it is.
      platform: None: JAX's default backend. A GPU runs the kernel, others interpret it.
    """
    # Imported here: it takes 0.1 s, and a run on CPUs need not wait for it.
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    warp = triton.CompilerParams(num_warps=1)
    interpret = (platform or jax.default_backend()) != "gpu"
    run = pallas.pallas_call(kernel, results, grid=grid, compiler_params=warp, interpret=interpret)
    return run(*inputs)


def copy(rows: list[Array]) -> list[Array]:
    """Returns arrays [n] unchanged, copied by kernels whose work XLA does not know."""
    copied: list[Array] = []
    for some in (rows[i : i + AT_ONCE] for i in range(0, len(rows), AT_ONCE)):
        results = [jax.ShapeDtypeStruct(row.shape, row.dtype) for row in some]
        blocks = -(-max(row.size for row in some) // BLOCK)
        copied += call(_copy_kernel, results, *some, grid=(blocks,))
    return copied


def _copy_kernel(*references: Any) -> None:
    """Copies a block of each array, if it has so many: all are read before one is written."""
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    half = len(references) // 2
    place = pallas.program_id(0) * BLOCK + jax.numpy.arange(BLOCK)
    masks = [place < source.shape[0] for source in references[:half]]
    read = [triton.load(x.at[place], mask=m) for x, m in zip(references, masks, strict=False)]
    for result, values, mask in zip(references[half:], read, masks, strict=True):
        triton.store(result.at[place], values, mask=mask)
