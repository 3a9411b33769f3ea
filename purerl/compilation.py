"""A run's programs: its beginning, an update, the evaluation.

They are compiled at the same time, since XLA does not hold Python's lock; where cores are few the
evaluation after the others, while the run already trains. With the `c` engine an update is two
programs, because JAX's cache refuses one with a call to the host: so the half that learns is
compiled once, not at every start. With MJX it is one: acting alone, 256 ants on two cores, never
ended (all of XLA's threads waiting, jax 0.10.2), where the whole update does.
"""

import functools
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, NamedTuple

import jax

from purerl import ppo
from purerl.config import Config
from purerl.deterministic import list_scatter_sums
from purerl.env import Env
from purerl.evaluation import evaluate_in_run
from purerl.experiment import Evaluation
from purerl.types import Array, Metrics, Network, PyTree, TrainState

# Two cores come to an ant's first update a second sooner without the evaluation's compiling beside
# it (9.6 s, `c`); 16 to its first evaluation on a GPU in 22 s with it, in 39 s without.
FEW_CORES = 7


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


def abstract_state(config: Config, env: Env, network: Network) -> PyTree:
    """Returns the shapes and dtypes of a run's state without computing anything."""
    return jax.eval_shape(functools.partial(ppo.init, config, env, network), jax.random.key(0))


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
        functools.partial(ppo.init, config, env, network),
        functools.partial(ppo.update, config, env, network),
        functools.partial(ppo.collect, config, env, network),
        functools.partial(ppo.improve, config, network),
        functools.partial(evaluate_in_run, config, env, network, evaluation.num_episodes),
    ]
    key = jax.random.key(0)
    if vmapped_seeds > 1:
        functions = [jax.vmap(function) for function in functions]
        key = jax.random.split(key, vmapped_seeds)
    init, whole, collect, improve, judge = functions
    abstract = jax.eval_shape(init, key)
    seconds: dict[str, float] = {}
    parts = [("collect", collect), ("improve", improve)] if calls_host else [("update", whole)]
    given, traced, started = (abstract,), [], []
    for name, part in parts:
        traced.append(jax.jit(part, donate_argnums=0).trace(*given))
        started.append(start(name, traced[-1], seconds))
        given = shapes(traced[-1].out_info)
    begin: Any = jax.jit(init)
    evaluate: Any = jax.jit(judge)
    beginning = start("init", begin.trace(key), seconds) if fresh else None
    if evaluation.number:
        first = [*started, beginning] if beginning else started
        evaluate = when_ready(start("evaluation", evaluate.trace(abstract), seconds, first))
    compiled = [part.result() for part in started]
    return Programs(
        init=beginning.result() if beginning else begin,
        update=functools.partial(update, *compiled) if calls_host else compiled[0],
        evaluate=evaluate,
        seconds=dict(seconds),  # the evaluation's comes later
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


def start(
    name: str, traced: Any, seconds: dict[str, float], first: Sequence[Future[Any]] = ()
) -> Future[Any]:
    """Compiles a traced program in a thread of its own, and notes how many seconds it took.

    On few cores after the programs `first`: what is needed later must not slow what is needed now.
    It then may end while the run trains.
    """
    begin = time.perf_counter()
    waits = bool(first) and len(os.sched_getaffinity(0)) <= FEW_CORES
    lowered = None if waits else traced.lower()

    def compile_it() -> Any:
        if waits:
            wait(first)
        compiled = (lowered or traced.lower()).compile()
        seconds[name] = time.perf_counter() - begin
        return compiled

    pool = ThreadPoolExecutor(1, f"purerl-compile-{name}")
    future = pool.submit(compile_it)
    pool.shutdown(wait=False)
    return future


def when_ready(program: Future[Any]) -> Callable[..., Any]:
    """Returns a function that calls a program, and before waits until it is compiled."""
    return lambda *arguments: program.result()(*arguments)


def unordered(traced: Any) -> list[str]:
    """Lists the sums of a traced program whose order nothing fixes on a GPU."""
    return sorted({f"{s.primitive} at {s.source}" for s in list_scatter_sums(traced.jaxpr)})
