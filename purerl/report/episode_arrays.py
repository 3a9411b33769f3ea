"""Episodes as arrays: what a policy observed, did and computed, step by step."""

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax

from purerl.core.keys import Purpose, derive
from purerl.core.records import Array, TrainState
from purerl.experiment.objects import Setup
from purerl.machine.state_arrays import Leaves, flatten
from purerl.ppo import distributions, episodes, evaluation


def note_modules(
    noted: dict[str, Array], change: Callable[[str, Array], Array] = lambda name, x: x
) -> Callable[..., Any]:
    """Returns an interceptor of Flax's calls that notes what each module returns, by its path.

    What is noted, and goes on to the next module, is `change(name, array)`.
    """

    def intercept(call: Callable, arguments: tuple, options: dict, context: Any) -> Any:
        result, path = call(*arguments, **options), "/".join(context.module.path)
        if not path or context.method_name != "__call__":
            return result

        def note(part: Any, array: Array) -> Array:
            name = jax.tree_util.keystr(part, simple=True, separator=".")
            name = f"{path}.{name}" if part else path
            while name in noted:
                name += "_again"  # one module, applied to several things
            noted[name] = change(name, array)
            return noted[name]

        return jax.tree_util.tree_map_with_path(note, result)

    return intercept


def play(
    setup: Setup, state: TrainState, reset_key: Array, number: int, steps: int
) -> tuple[evaluation.Progress, dict[str, Any]]:
    """Plays N whole episodes by the deterministic policy; pure.

    Args:
      setup: the experiment's objects.
      state: for `params` and `normalizer`, and the shape of one environment's memory.
      reset_key: [] typed; must not be one that training uses.
      number: N.
      steps: T, the control steps to play.

    Returns:
      The episodes after the last step, and arrays of all steps by name, [T, N, ...]: "state" and
      "memory" before the step, and "running", whether it belongs to the episode and left a state
      of finite numbers.
    """
    config, env, network, _ = setup

    def step(now: evaluation.Progress, _: None) -> tuple[evaluation.Progress, dict[str, Any]]:
        noted: dict[str, Array] = {}
        with nn.intercept_methods(note_modules(noted)):
            output, memory = episodes.act(network, state, now.env_state, now.memory)
        action = distributions.to_action(output.distribution.loc)
        following = evaluation.advance(env, now, action, memory)
        return following, {
            "running": ~(now.over | following.lost),
            "state": now.env_state,
            "action": action,
            "reward": following.env_state.reward,
            "terminated": following.env_state.terminated,
            "value": output.value,
            "memory": now.memory,
            "network": noted,
        }

    begun = evaluation.start(env, state, reset_key, number, config.episode_length)
    return jax.lax.scan(step, begun, length=steps)


def record(setup: Setup, state: TrainState, seed: int, number: int) -> Leaves:
    """Returns the arrays of N episodes by name, [N, T, ...], and their `length` [N].

    Args:
      setup: the experiment's objects.
      state: as `play` takes it.
      seed: of the episodes.
      number: N.
    """
    # As `evaluation.evaluate_policy` does: the same beginnings.
    key, _ = jax.random.split(derive(jax.random.key(seed), Purpose.EVALUATION))
    played = jax.jit(lambda s, key: play(setup, s, key, number, setup.config.episode_length)[1])
    rows = played(state, key)
    now = rows.pop("state")
    rows |= {name: getattr(now, name) for name in ("observation", "physics", "metrics", "task")}
    # Names of modules and metrics may have slashes of their own, which stay as they are.
    leaves = {name.replace("~1", "/"): x for name, x in flatten(rows).items() if x.size}
    arrays = {name: x.swapaxes(0, 1) for name, x in leaves.items()}
    length = arrays.pop("running").sum(axis=1)
    return {"length": length} | {name: x[:, : length.max()] for name, x in arrays.items()}
