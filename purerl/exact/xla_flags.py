"""Keeps XLA from choosing kernels by timing them, so that every process runs the same kernels.

On a GPU, XLA by default times several kernels for an operation and takes the fastest. Two processes
may choose differently, and another kernel adds in another order. Without timing:

- cuBLAS chooses well for large products. XLA's Triton products have one tile size and are slower (a
  rodent's physics by 10%, a gradient step by half; H100, jax 0.11.2), so they are off.
- XLA's own reductions are slow, so it is told to take Triton's by rule (a humanoid's physics is
  faster by 9%, that of ants over gaps by 12%; nothing else is slower).

XLA is also told to run small kernels side by side in a CUDA graph if they do not depend on each
other. That changes no bit (`lab/2026-11-22-kernels.md`).
"""

import os
import sys

TRITON_REDUCTIONS = "xla_gpu_experimental_enable_fusion_block_level_rewriter"
# What XLA does instead of timing.
RULES = {
    "xla_gpu_autotune_level": "0",
    "xla_gpu_enable_triton_gemm": "false",
    TRITON_REDUCTIONS: "true",
}
GRAPHS = {
    "xla_gpu_command_buffer_scheduling_mode": "CONCURRENT",
    "xla_gpu_graph_min_graph_size": "1",
}
# Passes that change bits with the number of devices. XLA runs the first for several devices alone,
# and it changes sums; the second merges products that share a factor, in an arbitrary order.
PASSES = "xla_disable_hlo_passes"
UNEQUAL_PASSES = "spmd-simplify,dot-merger"
FIXING_FLAGS = (
    "xla_gpu_autotune_level=0",
    "xla_gpu_deterministic_ops=true",
    "xla_gpu_exclude_nondeterministic_ops=true",
)
# On a CPU, what asks the processor what it can do, or how large its caches are, is left out:
# instructions beyond AVX, since LLVM fuses a product with a sum (FMA came with AVX2) or does not by
# what it knows of a processor's model; approximate reciprocals, which each maker rounds otherwise;
# YNNPACK and XNNPACK. Other libraries are left out by `portable.py`.
PORTABLE = {
    "xla_cpu_max_isa": "AVX",
    "xla_cpu_multi_thread_eigen": "false",
    "xla_cpu_enable_platform_dependent_math": "false",
    "xla_cpu_use_xnnpack": "false",
    "xla_cpu_experimental_ynn_fusion_type": "-dot,-eltwise,-reduce,-individual_dot"
    ",-individual_convolution",
    "xla_backend_extra_options": "xla_force_enable_experimental_llvm_ir_gemm",
}
# JAX keeps the timings of earlier processes beside its own cache, and XLA reads them there.
KEPT_TIMINGS = "JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES"


def jax_has_begun() -> bool:
    """Tells whether JAX has made its devices, after which it reads no environment."""
    if "jax" not in sys.modules:
        return False
    from jax._src import xla_bridge  # JAX has no public way to ask without starting it

    return xla_bridge.backends_are_initialized()


def set_xla_flags() -> None:
    """Adds to XLA_FLAGS what the user has not set there; to be called before JAX starts.

    If the user has set anything about timing, none of the `RULES` is added.

    Raises:
      RuntimeError: JAX has begun on a GPU, with kernels chosen by timing.
    """
    if jax_has_begun() and how_chosen(sys.modules["jax"].default_backend()) == "by timing":
        raise RuntimeError(
            "JAX has begun on the GPU with kernels chosen by timing: call "
            "purerl.exact.set_xla_flags() before JAX's first computation."
        )
    flags, wanted = os.environ.get("XLA_FLAGS", ""), dict(GRAPHS)
    if not any(name.partition("=")[0] in flags for name in FIXING_FLAGS):
        wanted |= RULES
        os.environ.setdefault(KEPT_TIMINGS, "none")
    added = [f"--{name}={value}" for name, value in wanted.items() if name not in flags]
    os.environ["XLA_FLAGS"] = " ".join([flags, *added]).strip()


def set_portable_flags() -> None:
    """Sets in the environment what makes a CPU's bits those of every x86-64 processor with AVX2.

    To be called before JAX starts. Only programs `without_libraries` have them.

    Raises:
      ValueError: XLA_FLAGS says otherwise.
      RuntimeError: JAX has begun with other flags.
    """
    if jax_has_begun() and not is_portable():
        raise RuntimeError(
            "JAX has begun with other flags than portable bits need: begin a new process, or call "
            "purerl.exact.set_portable_flags() before JAX's first computation."
        )
    flags = os.environ.get("XLA_FLAGS", "").split()
    for name, value in PORTABLE.items():
        wanted = f"--{name}={value}"
        user = [flag for flag in flags if flag.partition("=")[0] == f"--{name}"]
        if any(flag != wanted for flag in user):
            raise ValueError(f"XLA_FLAGS has {user[0]}; portable bits need {wanted}: leave it out.")
        flags += [] if user else [wanted]
    os.environ |= {"XLA_FLAGS": " ".join(flags), "NPROC": "1"}


def is_portable() -> bool:
    """Tells whether the environment is as `set_portable_flags` makes it."""
    flags = os.environ.get("XLA_FLAGS", "").split()
    one_thread = os.environ.get("NPROC") == "1"
    return one_thread and all(f"--{name}={value}" in flags for name, value in PORTABLE.items())


def how_chosen(platform: str) -> str:
    """Tells how XLA chooses kernels on a platform: "fixed", or "by timing" in each process."""
    flags = os.environ.get("XLA_FLAGS", "")
    fixed = platform != "gpu" or any(flag in flags for flag in FIXING_FLAGS)
    return "fixed" if fixed else "by timing"


def equal_passes() -> dict[str, str]:
    """Returns the compiler option that turns off `UNEQUAL_PASSES` in a program of several devices.

    The option replaces the one in XLA_FLAGS, so it contains the user's passes too.
    """
    flags = os.environ.get("XLA_FLAGS", "").split()
    users = [flag.partition("=")[2] for flag in flags if flag.startswith(f"--{PASSES}=")]
    return {PASSES: ",".join([UNEQUAL_PASSES, *users])}
