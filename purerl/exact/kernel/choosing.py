"""`with_kernel`: a function that one kernel computes where that is possible, faster and right."""

import concurrent.futures
import functools
import json
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from purerl.exact.kernel import compilers, compiling, launch

# Environments of a block. With 5 an ant among gaps is 2.3 times as fast as by XLA, a humanoid 1.4
# times (lab/2026-11-29-one-kernel-on-a-gpu.md); fewer have not been measured.
FEWEST = 5


def with_kernel(
    f: Callable, by_xla: Callable, reached: Callable, say: Callable[[str], None]
) -> Callable:
    """Returns `by_xla`, computed by one kernel of `f` where one can be had.

    A kernel is compared with XLA's results before its first use on a machine. The derivative is
    that of `by_xla`.

    Args:
      f: a pure function of pytrees, of one environment.
      by_xla: the same, as XLA shall compute it without a kernel.
      reached: (f, *example) -> arguments of several environments with a leading axis, of the shapes
        of the example, and what XLA makes of them. This f need not be traced again.
      say: is told once for each set of shapes what computes it: "one kernel" and who compiled it,
        or why it is XLA.
    """

    @functools.cache
    def kernel_of(tree: Any, shapes: tuple) -> compiling.Kernel | None:
        example = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*x) for x in shapes])
        kernel, said = _tried(f, reached, example)
        say(said)
        return kernel

    @functools.wraps(by_xla)
    def function(*args: Any) -> Any:
        leaves, tree = jax.tree.flatten(args)
        kernel = kernel_of(tree, tuple((np.shape(x), np.result_type(x)) for x in leaves))
        if kernel is None:
            return by_xla(*args)
        computed = jax.custom_jvp(kernel)
        computed.defjvp(functools.partial(jax.jvp, by_xla))
        return computed(*args)

    return jax.jit(function, inline=True)


def _tried(f: Callable, reached: Callable, example: tuple) -> tuple[compiling.Kernel | None, str]:
    """Returns a kernel that may be used, or None, and what `with_kernel` says."""
    # What is traced around this call is no business of the comparison: a thread has no trace. XLA
    # compiles there while a new text is written.
    with concurrent.futures.ThreadPoolExecutor(2) as threads:
        try:
            traced = compiling.traced(f, *example)
            by_xla = functools.cache(functools.partial(threads.submit, reached, traced, *example))
            kernel = compiling.kernel_of(traced, meanwhile=by_xla)
            by = f"NVRTC {compilers.nvrtc_version()}" if jax.default_backend() == "gpu" else "g++"
            block = compilers.block_of(kernel.text, launch.capability())
            if (fit := block.environments) < FEWEST:
                said = f"a block of this GPU has room for {fit} environments, of {FEWEST}"
                return None, f"XLA: {said}"
            whole = compilers.source(kernel.text, block)
            compare = functools.partial(_compared, kernel, by_xla)
            found = threads.submit(_known_agreement, whole, by, compare).result()
        except (compiling.NoRuleError, compilers.CompilerError) as error:
            return None, f"XLA: {error}"
        except jax.errors.JaxRuntimeError as error:  # a driver that is older than NVRTC, for one
            return None, f"XLA: the kernel does not start, {str(error).splitlines()[0]}"
    if not found.agrees:
        return None, f"XLA: the kernel's results differ, {found}"
    return kernel, f"one kernel, by {by}"


def _known_agreement(whole: str, by: str, compare: Callable) -> compiling.Agreement:
    """Returns how a kernel agrees with XLA: XLA takes longer to compile, so it is kept."""
    about = by, jax.__version__, str(launch.capability()), *compilers.GPU_WORDS
    path = compilers.kept(whole, about, "json", lambda _: json.dumps(compare()).encode())
    return compiling.Agreement(*json.loads(path.read_text()))


def _compared(kernel: compiling.Kernel, by_xla: Callable) -> compiling.Agreement:
    wait = by_xla().result
    if jax.default_backend() == "gpu":
        compilers.for_gpu(kernel.text, launch.capability())  # NVRTC compiles beside XLA
    args, wanted = wait()
    found = jax.jit(jax.vmap(kernel))(*args)
    return compiling.agreement(*map(compiling.as_rows, (found, wanted)))
