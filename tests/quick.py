"""Compiling in half the time what a test runs a few times, and only once for all."""

import functools
import os

import jax

# Little of LLVM, and XLA's older loops, where it still has them. Other bits than a run's: where a
# test is of those, it compiles as a run does.
OPTIONS: dict[str, bool | int] = {"xla_backend_optimization_level": 1}
if jax.__version_info__ < (0, 11):
    OPTIONS["xla_cpu_use_fusion_emitters"] = False

jit = functools.partial(jax.jit, compiler_options=OPTIONS)


def cached() -> dict[str, str]:
    """Returns an environment in which all tests' processes share what they compiled."""
    return os.environ | {
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_COMPILATION_CACHE_DIR": jax.config.values["jax_compilation_cache_dir"],
    }
