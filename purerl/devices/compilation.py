"""A run's programs: its beginning, an update, the evaluation.

They are compiled at the same time, since XLA does not hold Python's lock; where cores are few, the
evaluation when it is first needed. An update is two programs, which compile side by side, with the
`c` engine and on a GPU. With MJX on a CPU it is one: acting alone, 256 ants on two cores, never
ended (all of XLA's threads waiting, jax 0.10.2), where the whole update does.
"""

import contextlib
import functools
import gc
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax

from purerl import exact
from purerl.core.env import Env
from purerl.core.records import Array, Metrics, Network, PyTree, TrainState
from purerl.ppo import algorithm
from purerl.ppo.config import Config
from purerl.ppo.evaluation import evaluate_in_run
from purerl.runs.experiment import Evaluation

# Compiling takes all of few cores, so that the first update waits for whatever is not needed yet;
# 16 came to brax's ant's first evaluation on a GPU in 22 s with all side by side, in 39 s else (21
# November 2026, when its program was smaller).
FEW_CORES = 7
# LLVM's level on a CPU, 3 elsewhere: what runs once, or waits for MuJoCo, shall be ready soon. For
# an ant, `c`, `init` takes 1.5 s of a core instead of 3.3; `collect` 3.9 instead of 4.7
# and is as fast (at level 0 it takes 2.4, and is slower by 8%).
LEVELS = {"init": 0, "collect": 1}


class Programs(NamedTuple):
    """A run's compiled functions; of S vmapped seeds every array has a leading axis [S].

    `update` and `evaluate` take a TrainState, or what `spread` makes of one for several devices.
    """

    init: Callable[[Array], TrainState]
    update: Callable[[Any], tuple[Any, Metrics]]
    evaluate: Callable[[Any], Metrics]
    seconds: dict[str, float]  # that each took to compile, side by side; without the evaluation
    unordered: list[str]  # sums of the update whose order nothing fixes on a GPU
    spread: Callable[[TrainState], Any] = lambda state: state  # onto the devices, for the others
    fetch: Callable[[Any], TrainState] = lambda state: state  # back onto one


def set_up_jax(cache: bool) -> str:
    """Sets what bits depend on, whatever a later JAX's defaults; returns the cache's folder.

    Without `cache`, or with JAX_ENABLE_COMPILATION_CACHE=false in the environment, there is none.
    """
    jax.config.update("jax_threefry_partitionable", True)
    jax.config.update("jax_default_prng_impl", "threefry2x32")
    if not cache or not jax.config.values["jax_enable_compilation_cache"]:
        jax.config.update("jax_enable_compilation_cache", False)
        return "off"
    # JAX has read JAX_COMPILATION_CACHE_DIR by now, if it is set.
    folder = jax.config.values["jax_compilation_cache_dir"] or str(cache_folder())
    jax.config.update("jax_compilation_cache_dir", folder)
    return folder


def cache_folder() -> Path:
    """Returns the folder for compiled programs, where the user keeps caches (XDG_CACHE_HOME)."""
    caches = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not caches.is_absolute():  # the freedesktop.org specification takes no other
        caches = Path.home() / ".cache"
    return caches / "purerl" / "jax"


@contextlib.contextmanager
def no_collection() -> Iterator[None]:
    """Keeps Python from looking for garbage, of which tracing makes none but millions of objects.

    An ant's first update with MJX, on two cores, came after 10 s instead of 12.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def abstract_state(config: Config, env: Env, network: Network) -> PyTree:
    """Returns the shapes and dtypes of a run's state without computing anything."""
    return jax.eval_shape(
        functools.partial(algorithm.init, config, env, network), jax.random.key(0)
    )


def compile_programs(
    config: Config,
    env: Env,
    network: Network,
    evaluation: Evaluation,
    fresh: bool,
    vmapped_seeds: int = 1,
    calls_host: bool = False,
) -> Programs:
    """Compiles what a run calls; `init` only for a fresh one, `evaluate` only if planned.

    With `calls_host`, as the `c` engine does, an update is compiled as two programs.
    """
    functions: list[Callable[..., Any]] = [
        # Initialisation is a program too: computed eagerly, its bits are others.
        functools.partial(algorithm.init, config, env, network),
        functools.partial(algorithm.update, config, env, network),
        functools.partial(algorithm.collect, config, env, network),
        functools.partial(algorithm.improve, config, network),
        functools.partial(evaluate_in_run, config, env, network, evaluation.num_episodes),
    ]
    key = jax.random.key(0)
    if vmapped_seeds > 1:
        functions = [jax.vmap(function) for function in functions]
        key = jax.random.split(key, vmapped_seeds)
    init, whole, collect, improve, judge = functions
    abstract = jax.eval_shape(init, key)
    seconds: dict[str, float] = {}
    in_halves = calls_host or jax.default_backend() == "gpu"
    parts = [("collect", collect), ("improve", improve)] if in_halves else [("update", whole)]
    given, traced, started = (abstract,), [], []
    for name, part in parts:
        traced.append(jit(name, part, donate_argnums=0).trace(*given))
        started.append(start(name, traced[-1], seconds))
        given = shapes(traced[-1].out_info)
    begin, evaluate = jit("init", init), jit("evaluation", judge)
    beginning = start("init", begin.trace(key), seconds) if fresh else None
    if evaluation.number:
        evaluate = when_needed("evaluation", evaluate, abstract, seconds)
    compiled = [part.result() for part in started]
    return Programs(
        init=beginning.result() if beginning else begin,
        update=functools.partial(update, *compiled) if in_halves else compiled[0],
        evaluate=evaluate,
        seconds=dict(seconds),  # the evaluation's may come later
        unordered=sorted({place for part in traced for place in unordered(part)}),
    )


def update(
    collect: Callable[..., Any], improve: Callable[..., Any], state: TrainState
) -> tuple[TrainState, Metrics]:
    """Makes an update of its two halves, as `ppo.update` does; returns before it is computed."""
    return improve(*collect(state))


def shapes(tree: PyTree, sharding: Any = None) -> PyTree:
    """Returns the shapes and dtypes of a tree of anything that has them, laid out as `sharding`."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), tree)


def jit(name: str, function: Callable, **options: Any) -> Any:
    """Returns `jax.jit` of a run's program, at its level of LLVM wherever it is compiled.

    At another level its bits are others.
    """
    on_cpu = name in LEVELS and jax.default_backend() == "cpu"
    level = {"xla_backend_optimization_level": LEVELS[name]} if on_cpu else None
    return jax.jit(function, compiler_options=level, **options)


def start(name: str, traced: Any, seconds: dict[str, float]) -> Future[Any]:
    """Compiles a traced program in a thread of its own, and notes how many seconds it took."""
    begin, lowered = time.perf_counter(), traced.lower()

    def compile_it() -> Any:
        compiled = lowered.compile()
        seconds[name] = time.perf_counter() - begin
        return compiled

    pool = ThreadPoolExecutor(1, f"purerl-compile-{name}")
    future = pool.submit(compile_it)
    pool.shutdown(wait=False)
    return future


def when_needed(
    name: str, function: Any, example: PyTree, seconds: dict[str, float]
) -> Callable[..., Any]:
    """Returns a jitted function, compiled beside the others, or on few cores when it is called."""
    if len(os.sched_getaffinity(0)) <= FEW_CORES:
        return function
    program = start(name, function.trace(example), seconds)
    return lambda *arguments: program.result()(*arguments)


def unordered(traced: Any) -> list[str]:
    """Lists the sums of a traced program whose order nothing fixes on a GPU."""
    return sorted({f"{s.primitive} at {s.source}" for s in exact.unordered_in(traced.jaxpr)})
