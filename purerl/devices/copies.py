"""Arrays copied by a kernel of our own, written in Pallas, where a GPU can run one."""

import importlib.util
from typing import Any

import jax
from jax import Array

AT_ONCE = 32  # arrays that one kernel copies: each takes registers
BLOCK = 128  # entries of each that a warp copies, four a thread


def can_run() -> bool:
    """Tells whether JAX's default backend runs kernels of our own.

    It is a GPU, and JAX has Triton's part of Pallas. JAX means to remove that; then XLA's loops
    are used.
    """
    try:
        there = importlib.util.find_spec("jax.experimental.pallas.triton") is not None
    except ModuleNotFoundError:  # not even what it is a part of
        there = False
    return there and jax.default_backend() == "gpu"


def copy(rows: list[Array]) -> list[Array]:
    """Returns arrays [n] unchanged, copied by kernels whose work XLA does not know."""
    # Imported here: it takes 0.1 s, and a run on CPUs need not wait for it.
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    how: dict[str, Any] = {"compiler_params": triton.CompilerParams(num_warps=1)}
    how["interpret"] = jax.default_backend() != "gpu"
    copied: list[Array] = []
    for some in (rows[i : i + AT_ONCE] for i in range(0, len(rows), AT_ONCE)):
        results = [jax.ShapeDtypeStruct(row.shape, row.dtype) for row in some]
        blocks = -(-max(row.size for row in some) // BLOCK)
        copied += pallas.pallas_call(_copy_kernel, results, grid=(blocks,), **how)(*some)
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
