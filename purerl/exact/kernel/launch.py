"""A kernel as an operation of JAX: under `vmap` the batch is the grid.

On a GPU XLA starts the PTX itself, as a part of its program. On a CPU the C++ is called back.
"""

import ctypes
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jax.interpreters import batching, mlir

from purerl.exact.kernel import compilers
from purerl.exact.kernel.text import Text

DTYPES = {"f": np.float32, "i": np.int32, "b": np.int32}  # of the arrays that a kernel reads
WITHOUT_A_GPU = 90  # compute capability for which a program is made where there is no GPU

primitive = core.Primitive("kernel")
primitive.multiple_results = True


def run(text: Text, *arrays: Any) -> list[jax.Array]:
    """Runs a kernel on arrays [..., n], each of its kind; returns arrays [..., m]."""
    return primitive.bind(*arrays, text=text)


@primitive.def_impl
def _now(*arrays: Any, **params: Any) -> list[jax.Array]:
    return jax.jit(functools.partial(primitive.bind, **params))(*arrays)


@primitive.def_abstract_eval
def _shapes(*avals: Any, text: Text) -> list[jax.core.ShapedArray]:
    batch = avals[0].shape[:-1]
    return [jax.core.ShapedArray((*batch, n), DTYPES[kind]) for n, kind in text.outputs]


def _batched(arrays: Sequence[Any], axes: Sequence[int | None], **params: Any) -> tuple:
    """Every environment has its own row of each array."""
    size = next(x.shape[a] for x, a in zip(arrays, axes, strict=True) if a is not None)
    rows = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(arrays, axes, strict=True)
    ]
    return primitive.bind(*rows, **params), [0] * len(params["text"].outputs)


batching.primitive_batchers[primitive] = _batched


# --- on a CPU ---


def _called_back(*arrays: Any, text: Text) -> Any:
    batch = arrays[0].shape[:-1]
    shapes = [jax.ShapeDtypeStruct((*batch, n), DTYPES[kind]) for n, kind in text.outputs]
    host = functools.partial(on_host, compilers.on_cpu(text), text)
    return jax.pure_callback(host, shapes, *arrays)


def on_host(function: Any, text: Text, *arrays: Any) -> list[np.ndarray]:
    """Calls the C++ of a kernel on arrays [..., n]."""
    batch = np.shape(arrays[0])[:-1]
    kinds = [DTYPES[kind] for _, kind in text.inputs]
    given = [np.ascontiguousarray(x, kind) for x, kind in zip(arrays, kinds, strict=True)]
    found = [np.empty((*batch, n), DTYPES[kind]) for n, kind in text.outputs]
    count = np.array([int(np.prod(batch, dtype=int))], np.int32)
    function(*(x.ctypes.data_as(ctypes.c_void_p) for x in (count, *given, *found)))
    return found


mlir.register_lowering(primitive, mlir.lower_fun(_called_back), platform="cpu")


# --- on a GPU ---

launched = core.Primitive("kernel_launch")
launched.multiple_results = True


def _with_number(*arrays: Any, text: Text) -> list[jax.Array]:
    """Adds the number of environments, which the kernel reads: its text is for any number."""
    number = int(np.prod(arrays[0].shape[:-1], dtype=int))
    return launched.bind(jnp.array([number], jnp.int32), *arrays, text=text)


launched.def_abstract_eval(lambda number, *avals, text: _shapes(*avals, text=text))


def _launch(ctx: Any, *nodes: Any, text: Text) -> Any:
    """Lowers to a call of the kernel's PTX, with a block for so many environments."""
    number = int(np.prod(ctx.avals_in[1].shape[:-1], dtype=int))
    chip = capability()
    block = compilers.block_of(text, chip)
    blocks = -(-number // block.environments)
    name, config = by_xla(compilers.for_gpu(text, chip), text, blocks, block)
    return jax.ffi.ffi_lowering(name, backend_config=config)(ctx, *nodes)


def by_xla(ptx: str, text: Text, blocks: int, block: compilers.Block) -> tuple[str, dict[str, Any]]:
    """Returns XLA's own call of PTX: it starts it as one of its kernels, also in CUDA graphs."""
    words = {"name": "kernel", "kernel_type": "ptx", "kernel_data": ptx}
    numbers = {"grid_x": blocks, "block_x": 32 * block.environments * block.warps}
    numbers["shared_mem_bytes"] = 4 * text.memory * block.environments
    numbers |= dict.fromkeys(("grid_y", "grid_z", "block_y", "block_z"), 1)
    config = {name: mlir.ir.StringAttr.get(word) for name, word in words.items()}
    return "__gpu$xla.gpu.ptx", config | {n: mlir.i32_attr(x) for n, x in numbers.items()}


def capability() -> int:
    """Returns the compute capability of the GPU, as 90."""
    found = [x.compute_capability for x in jax.local_devices() if x.platform == "gpu"]
    return int(str(found[0]).replace(".", "")) if found else WITHOUT_A_GPU


mlir.register_lowering(primitive, mlir.lower_fun(_with_number), platform="cuda")
mlir.register_lowering(launched, _launch, platform="cuda")
