"""Compiling in a quarter of the time what a test runs a few times."""

from collections.abc import Callable
from typing import Any

import jax

# Nothing of LLVM, and XLA's older loops, where it still has them: an update of the tests compiles
# in 1.7 s of a core, not 6.7 (at LLVM's level 1 in 2.8). Other bits than a run's: where a test is
# of those, it compiles as a run does.
OPTIONS: dict[str, bool | int] = {"xla_backend_optimization_level": 0}
if jax.__version_info__ < (0, 11):
    OPTIONS["xla_cpu_use_fusion_emitters"] = False

# For the XLA_FLAGS of a process.
FLAGS = " ".join(f"--{name}={value}" for name, value in OPTIONS.items())
JAX_JIT = jax.jit  # which the fixture `compiled_quickly` replaces


def jit(function: Callable, **options: Any) -> Any:
    """Returns `jax.jit` of a function that is compiled quickly."""
    return JAX_JIT(function, **options | {"compiler_options": OPTIONS})
