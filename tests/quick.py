"""Compiling in a quarter of the time what a test runs a few times, and a run's programs once."""

import functools
from collections.abc import Callable
from typing import Any

import jax
from jax._src.core import trace_state_clean  # JAX has no public way to ask whether it traces

from purerl import exact
from purerl.experiment.settings_json import settings_of

# Nothing of LLVM, and XLA's older loops, where it still has them: an update of the tests compiles
# in 1.7 s of a core, not 6.7 (at LLVM's level 1 in 2.8). Other bits than a run's: where a test is
# of those, it compiles as a run does.
OPTIONS: dict[str, bool | int] = {"xla_backend_optimization_level": 0}
if jax.__version_info__ < (0, 11):
    OPTIONS["xla_cpu_use_fusion_emitters"] = False

# For the XLA_FLAGS of a process.
FLAGS = " ".join(f"--{name}={value}" for name, value in OPTIONS.items())
JAX_JIT = jax.jit


def jit(function: Callable, **options: Any) -> Any:
    """Returns `jax.jit` of a function that is compiled quickly."""
    return JAX_JIT(function, **options | {"compiler_options": OPTIONS})


class Jit:
    """In place of `jax.jit`: it compiles quickly; inside of what is traced it is as it was."""

    def __init__(self, function: Callable, **options: Any) -> None:
        self._made = function, options
        self._quick, self._inner = jit(function, **options), JAX_JIT(function, **options)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        function = self._quick if trace_state_clean() else self._inner
        return function(*args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._quick, name)

    def __reduce__(self) -> tuple:  # a copy of an environment has a copy of it
        function, options = self._made
        return functools.partial(Jit, **options), (function,)


def kept(compile_job: Callable) -> Callable:
    """Returns `seeds._compile` that traces and compiles once what all it depends on is equal of.

    That is what the manifest says of a process, the settings, the seed among them, and whether the
    run begins.
    """
    made: dict[str, Any] = {}

    @functools.wraps(compile_job)
    def once(job: Any, fresh: bool) -> Any:
        settings, jit_used = settings_of(job.chosen), jax.jit is JAX_JIT
        seeds = job.options.vmapped_seeds
        key = repr((job.facts, settings, seeds, job.shards, fresh, exact.is_portable(), jit_used))
        if key not in made:
            made[key] = compile_job(job, fresh)
        return made[key]

    return once
