"""Keeps XLA from choosing kernels by timing them, so that every process computes with the same.

On a GPU, XLA by default times several kernels for an operation and takes the fastest. Two processes
may choose differently, and other kernels add in another order.
"""

import os

LEVEL = "xla_gpu_autotune_level"
FIXING_FLAGS = (
    f"{LEVEL}=0",
    "xla_gpu_deterministic_ops=true",
    "xla_gpu_exclude_nondeterministic_ops=true",
)


def fix_choice() -> None:
    """Turns the timing off, where XLA_FLAGS does not set it; to be called before JAX starts."""
    flags = os.environ.get("XLA_FLAGS", "")
    if not any(name.partition("=")[0] in flags for name in FIXING_FLAGS):
        os.environ["XLA_FLAGS"] = f"{flags} --{LEVEL}=0".strip()


def how_chosen(platform: str) -> str:
    """Tells how kernels are chosen: "fixed", or "by timing" anew in each process."""
    flags = os.environ.get("XLA_FLAGS", "")
    fixed = platform != "gpu" or any(flag in flags for flag in FIXING_FLAGS)
    return "fixed" if fixed else "by timing"
