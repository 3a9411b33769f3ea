"""A run's policy as one pure function of what it reads: what `jax` and `onnx` files are made of."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.records import Array, PyTree
from purerl.ppo import distributions, running_moments
from purerl.ppo.episodes import start_memory
from purerl.report.flat_program import flat_program
from purerl.runs.loaded_run import Run


class PolicyFunction(NamedTuple):
    """A function of batches, and examples of one environment's arguments."""

    act: Callable[[PyTree, PyTree], tuple[Array, PyTree]]  # see `policy_function`
    observation: PyTree  # leaves [O]
    memory: PyTree  # leaves [H], as an episode starts: zeros


def policy_function(run: Run) -> PolicyFunction:
    """Returns `act(observation, memory) -> (action, memory)` with leading axes [N, ...].

    Normalization and tanh are inside. Of an observation that is a dict, `act` takes only the
    entries that the action or the memory depends on: those for the value function are left out.
    """
    network, state = run.network, run.state
    shapes = jax.eval_shape(run.env.reset, jax.random.key(0)).observation
    everything = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    memory = jax.tree.map(lambda x: x[0], start_memory(state.memory, 1))

    def act(observation: PyTree, memory: PyTree) -> tuple[Array, PyTree]:
        seen = running_moments.normalize(state.normalizer, observation)
        output, memory = network.apply(state.params, seen, memory)
        return distributions.to_action(output.distribution.loc), memory

    if not isinstance(everything, dict):
        return PolicyFunction(act, everything, memory)
    read = flat_program(act, everything, memory).read
    names = [name for number, name in enumerate(sorted(everything)) if number in read]
    needed = {name: everything[name] for name in names}

    def act_on(observation: dict[str, Any], memory: PyTree) -> tuple[Array, PyTree]:
        number = next(iter(observation.values())).shape[0]
        absent = {k: jnp.zeros((number, *x.shape), x.dtype) for k, x in everything.items()}
        return act(absent | observation, memory)

    return PolicyFunction(act_on, needed, memory)
