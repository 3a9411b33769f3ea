"""Kernels of our own, written in Pallas: where they can run, and how they are called."""

import importlib.util
from collections.abc import Callable

import jax

from purerl.types import Array


def can_run() -> bool:
    """Tells whether programs are for a GPU, and JAX has Triton's part of Pallas.

    JAX means to remove it; then XLA's kernels and loops are used.
    """
    on_gpu = jax.default_backend() == "gpu"
    return on_gpu and importlib.util.find_spec("jax.experimental.pallas.triton") is not None


def call(
    kernel: Callable[..., None],
    results: list[jax.ShapeDtypeStruct],
    *inputs: Array,
    in_place: bool = False,
) -> list[Array]:
    """Runs a kernel in one warp; vmapped, in a warp for each.

    Args:
      kernel: takes a reference to each input, then to each result, and writes the results.
      results: their shapes and dtypes.
      *inputs: the arrays to read.
      in_place: whether each input is overwritten by a result, which is the input until then.
    """
    # Imported here: it takes 0.1 s, of which a run on CPUs need not wait.
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    return pallas.pallas_call(
        kernel,
        results,
        input_output_aliases={i: i for i in range(len(inputs))} if in_place else {},
        compiler_params=triton.CompilerParams(num_warps=1),
        interpret=jax.default_backend() == "cpu",
    )(*inputs)
