"""Episodes as arrays: what a policy observed, did and computed, step by step."""

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import numpy as np

from purerl.core.keys import Purpose, derive
from purerl.core.records import Array, TrainState
from purerl.ppo import distributions
from purerl.ppo.evaluation import Progress, advance, start
from purerl.ppo.rollout import act
from purerl.runs import build_experiment, state_arrays


def note_modules(noted: dict[str, Array]) -> Callable[..., Any]:
    """Returns an interceptor of Flax's calls that notes what each module returns, by its path."""

    def intercept(call: Callable, arguments: tuple, options: dict, context: Any) -> Any:
        result = call(*arguments, **options)
        path = "/".join(context.module.path)
        if path and context.method_name == "__call__":
            for part, array in jax.tree_util.tree_leaves_with_path(result):
                name = jax.tree_util.keystr(part, simple=True, separator=".")
                name = f"{path}.{name}" if part else path
                while name in noted:
                    name += "_again"  # one module, applied to several things
                noted[name] = array
        return result

    return intercept


def play(
    setup: build_experiment.Setup, state: TrainState, key: Array, number: int
) -> dict[str, Any]:
    """Plays N whole episodes by the deterministic policy; pure. Returns arrays [T, N, ...]."""
    config, env, network, _ = setup
    reset_key, _ = jax.random.split(key)  # as `evaluation.evaluate` does: the same beginnings

    def step(now: Progress, _: None) -> tuple[Progress, dict[str, Any]]:
        noted: dict[str, Array] = {}
        with nn.intercept_methods(note_modules(noted)):
            output, memory = act(network, state, now.env, now.memory)
        action = distributions.to_action(output.distribution.loc)
        following = advance(env, now, action, memory)
        return following, {
            "running": ~(now.over | following.lost),
            "observation": now.env.observation,
            "physics": now.env.physics,
            "metrics": now.env.metrics,
            "task": now.env.task,
            "action": action,
            "reward": following.env.reward,
            "value": output.value,
            "memory": now.memory,
            "network": noted,
        }

    begin = start(config, env, state, reset_key, number)
    return jax.lax.scan(step, begin, length=config.episode_length)[1]


def record(
    setup: build_experiment.Setup, state: TrainState, seed: int, number: int
) -> state_arrays.Leaves:
    """Returns the arrays of N episodes by name, [N, T, ...], and their `length` [N]."""
    key = derive(jax.random.key(seed), Purpose.EVALUATION)
    rows = jax.jit(lambda state, key: play(setup, state, key, number))(state, key)
    arrays = {
        name: np.swapaxes(x, 0, 1) for name, x in state_arrays.flatten(rows).items() if x.size
    }
    length = arrays.pop("running").sum(axis=1)
    return {"length": length} | {name: x[:, : length.max()] for name, x in arrays.items()}
