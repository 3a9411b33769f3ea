"""Compiling in half the time what a test runs a few times."""

import functools

import jax

# XLA's older loops, and little of LLVM. Other bits than a run's: where a test is of those, it
# compiles as a run does.
OPTIONS = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}

jit = functools.partial(jax.jit, compiler_options=OPTIONS)
