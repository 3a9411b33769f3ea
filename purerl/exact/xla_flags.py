"""Keeps XLA from choosing kernels by timing them, so that every process computes with the same.

On a GPU, XLA by default times several kernels for an operation and takes the fastest. Two processes
may choose differently, and other kernels add in another order. Untimed, cuBLAS's own choice is good
where a product is large enough (`slices.count_slices`); XLA's Triton products, of one untimed tile
size, are not (slower: a rodent's physics by 10%, a gradient step by half; H100, jax 0.11.2). Of
reductions it is the other way round: XLA's own are slow untimed, and it takes Triton's by rule when
told to (a humanoid's physics faster by 9%, that of ants over gaps by 12%; ants on a floor, rodents
and the learner alike).

Most kernels are small, in a CUDA graph, and one after another unless XLA is told to let those run
together that need nothing of each other. It changes no bit: `docs/gpu.md`.
"""

import os

LEVEL = "xla_gpu_autotune_level"
# In the place of what timing would have found out.
RULES = {
    LEVEL: "0",
    "xla_gpu_enable_triton_gemm": "false",
    "xla_gpu_experimental_enable_fusion_block_level_rewriter": "true",
}
GRAPHS = {
    "xla_gpu_command_buffer_scheduling_mode": "CONCURRENT",
    "xla_gpu_graph_min_graph_size": "1",
}
# Passes that change bits with the number of devices. The first is run for several alone, and makes
# other sums; the second puts products together that share a factor, in an order that is arbitrary.
PASSES = "xla_disable_hlo_passes"
UNEQUAL_PASSES = "spmd-simplify,dot-merger"
FIXING_FLAGS = (
    f"{LEVEL}=0",
    "xla_gpu_deterministic_ops=true",
    "xla_gpu_exclude_nondeterministic_ops=true",
)
# JAX keeps what XLA timed in an earlier process beside its own cache, and XLA takes it from there.
KEPT_TIMINGS = "JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES"


def set_xla_flags() -> None:
    """Sets what XLA_FLAGS does not; to be called before JAX starts.

    Where it says anything of timing, that holds, and none of the `RULES` does.
    """
    flags, wanted = os.environ.get("XLA_FLAGS", ""), dict(GRAPHS)
    if not any(name.partition("=")[0] in flags for name in FIXING_FLAGS):
        wanted |= RULES
        os.environ.setdefault(KEPT_TIMINGS, "none")
    added = [f"--{name}={value}" for name, value in wanted.items() if name not in flags]
    os.environ["XLA_FLAGS"] = " ".join([flags, *added]).strip()


def how_chosen(platform: str) -> str:
    """Tells how kernels are chosen: "fixed", or "by timing" anew in each process."""
    flags = os.environ.get("XLA_FLAGS", "")
    fixed = platform != "gpu" or any(flag in flags for flag in FIXING_FLAGS)
    return "fixed" if fixed else "by timing"


def equal_passes() -> dict[str, str]:
    """Returns the compiler option for a program of several devices: which passes are off.

    It takes the place of what XLA_FLAGS says of passes, so that is a part of it.
    """
    flags = (flag.lstrip("-").partition("=") for flag in os.environ.get("XLA_FLAGS", "").split())
    users = [value for name, _, value in flags if name == PASSES]
    return {PASSES: ",".join([UNEQUAL_PASSES, *users])}
