"""Compiling in half the time what a test runs a few times."""

import functools

import jax

# Little of LLVM, and XLA's older loops, where it still has them. Other bits than a run's: where a
# test is of those, it compiles as a run does.
OPTIONS: dict[str, bool | int] = {"xla_backend_optimization_level": 1}
if jax.__version_info__ < (0, 11):
    OPTIONS["xla_cpu_use_fusion_emitters"] = False

jit = functools.partial(jax.jit, compiler_options=OPTIONS)
