"""A run's compiled programs: its beginning, an update, the evaluation.

They are compiled at the same time, since XLA does not hold Python's lock. On few cores, the
evaluation is compiled when it is first needed. An update is two programs, which compile side by
side, with the `c` engine and on a GPU. With MJX on a CPU it is one: a program that only acts, 256
ants on two cores, never ended (all of XLA's threads waiting, jax 0.10.2), and a whole update does.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.env import Env
from purerl.core.keys import Purpose, derive
from purerl.core.records import Array, Metrics, Network, PolicyOutput, PyTree, TrainState
from purerl.devices import compilation, multi_device
from purerl.devices.shards import Shards, improve
from purerl.ppo import algorithm, episodes
from purerl.ppo.config import Config, Evaluation
from purerl.ppo.evaluation import evaluate_policy


class Programs(NamedTuple):
    """A run's compiled functions; with S vmapped seeds every array has a leading axis [S].

    `update` and `evaluate` take a TrainState, or what `spread` makes of one for several devices.
    """

    init: Callable[[Array], TrainState]
    update: Callable[[Any], tuple[Any, Metrics]]
    evaluate: Callable[[Any], Metrics]
    seconds: dict[str, float]  # that each took to compile, side by side; without the evaluation
    policy: Callable[[TrainState], PolicyOutput]  # [B, ...] of a fetched state
    unordered: list[str]  # sums of the update whose order nothing fixes on a GPU
    spread: Callable[[TrainState], Any] = compilation.as_it_is  # onto the devices, for the others
    fetch: Callable[[Any], TrainState] = compilation.as_it_is  # back onto one


def abstract_state(config: Config, env: Env, network: Network) -> PyTree:
    """Returns the shapes and dtypes of a run's state without computing anything."""
    init = functools.partial(algorithm.init, config, env, network)
    return jax.eval_shape(init, jax.random.key(0))


def compile_programs(
    config: Config,
    env: Env,
    network: Network,
    evaluation: Evaluation,
    fresh: bool,
    shards: Shards,
    vmapped_seeds: int = 1,
    calls_host: bool = False,
) -> Programs:
    """Compiles what a run calls.

    Args:
      config: the hyperparameters.
      env: the environment.
      network: the network.
      evaluation: whether there are evaluations, and of how many episodes.
      fresh: whether the run begins, so that `init` is needed.
      shards: how the batch is cut; more than one are laid out over the devices.
      vmapped_seeds: S.
      calls_host: whether the environment's physics does, as the `c` engine.
    """
    # Initialisation is a program too: computed operation by operation, it has other bits.
    init: Any = functools.partial(algorithm.init, config, env, network)
    judge: Any = functools.partial(evaluate_in_run, config, env, network, evaluation.num_episodes)
    policy: Any = functools.partial(policy_of, network)
    key = jax.random.key(0)
    if vmapped_seeds > 1:
        one_by_one = network._replace(init=in_turn(network.init))
        init = functools.partial(algorithm.init, config, env, one_by_one)
        init, judge, policy = jax.vmap(init), jax.vmap(judge), jax.vmap(policy)
        key = jax.random.split(key, vmapped_seeds)
    with compilation.no_collection():
        begin, evaluate = compilation.jit("init", init), compilation.jit("evaluation", judge)
        # First: it has no step, so on a GPU it is compiled while a kernel is made of one.
        beginning = compilation.start("init", begin.trace(key)) if fresh else None
        abstract = jax.eval_shape(init, key)
        task = (config, env, network, abstract)
        if shards.number > 1:
            compiling = multi_device.compile_update(shards, *task)
        else:
            in_halves = calls_host or jax.default_backend() == "gpu"
            compiling = compile_update(*task, vmapped_seeds > 1, in_halves)
        if evaluation.number:
            evaluate = compilation.when_needed("evaluation", evaluate, compiling.judged)
        update, seconds = compiling.finish()
        if beginning:
            begin, seconds["init"] = beginning.result()
    return Programs(
        init=begin,
        update=update,
        evaluate=lambda state: evaluate(compiling.to_judge(state)),
        seconds=seconds,
        unordered=compiling.unordered,
        spread=compiling.spread,
        fetch=compiling.fetch,
        policy=jax.jit(policy),
    )


def in_turn(init: Callable[[Array], PyTree]) -> Callable[[Array], PyTree]:
    """Returns a function that is computed for each key by itself under vmap, as without it.

    A cell begins with orthogonal matrices. jaxlib factorises a batch of them in parts, and two such
    factorisations on two threads wait for each other for ever: see `threads`.
    """
    alone = jax.custom_batching.custom_vmap(init)

    @alone.def_vmap
    def _(size: int, _: Any, keys: Array) -> tuple[PyTree, PyTree]:
        made = jax.tree.map(lambda *x: jnp.stack(x), *[init(keys[i]) for i in range(size)])
        return made, jax.tree.map(lambda _: True, made)

    return alone


def evaluate_in_run(
    config: Config, env: Env, network: Network, num_episodes: int, state: TrainState
) -> Metrics:
    """Evaluates the deterministic policy on episodes that depend on seed and update alone."""
    key = derive(state.key, Purpose.EVALUATION, state.update)
    return evaluate_policy(env, network, state, key, num_episodes, config.episode_length)


def policy_of(network: Network, state: TrainState) -> PolicyOutput:
    """Returns what the network says in the environments of a state, [B, ...]."""
    drawn = episodes.draw(network, state.key, state.env_ids, state.update)
    return episodes.act(network, state, state.env_state, state.memory, drawn)[0]


def compile_update(
    config: Config, env: Env, network: Network, abstract: TrainState, vmapped: bool, in_halves: bool
) -> compilation.Compiling:
    """Compiles an update on one device, as one program or `in_halves`: acting, then learning.

    The `abstract` shapes of the state are [S, ...] if `vmapped`.
    """
    one: dict[str, Callable] = {"update": functools.partial(algorithm.update, config, env, network)}
    halves: dict[str, Callable] = {
        "collect": functools.partial(algorithm.collect, config, env, network),
        "improve": functools.partial(improve, config, network, Shards()),
    }
    given, traced, started = (abstract,), [], []
    for name, function in (halves if in_halves else one).items():
        function = jax.vmap(function) if vmapped else function
        traced.append(compilation.jit(name, function, donate_argnums=0).trace(*given))
        started.append((name, compilation.start(name, traced[-1])))
        given = compilation.shapes(traced[-1].out_info)

    def finish() -> tuple[Callable[[Any], tuple[Any, Metrics]], dict[str, float]]:
        done = {name: program.result() for name, program in started}
        programs = [program for program, _ in done.values()]
        seconds = {name: took for name, (_, took) in done.items()}
        return functools.partial(update, *programs) if in_halves else programs[0], seconds

    sums = sorted({place for part in traced for place in compilation.unordered(part)})
    return compilation.Compiling(finish, sums, judged=abstract)


def update(
    collect: Callable[..., Any], improve: Callable[..., Any], state: TrainState
) -> tuple[TrainState, Metrics]:
    """Makes an update of its two halves, as `algorithm.update` does; does not wait for it."""
    return improve(*collect(state))
