"""What a trained policy did, felt and computed, step by step, as arrays in one file.

    python -m experiments.record_episodes runs/ant_gaps/seed1 --out episodes.npz

The episodes begin as those of `python -m purerl.evaluate RUN --engine E --seed S` with as many of
them do: deterministic, in fresh environments. They are computed by another program, whose last bits
differ: a body with contacts goes its own way in the end, so count returns from `reward` here. Every
array is [N, T, ...] but for `length`, N episodes of at most T policy steps:

    length [N]          policy steps of the episode; what comes after them is no part of it
    observation         before the step, as the environment gives it (the network gets it
                        normalized), [O] or a dict's parts
    physics/qpos ...    the simulation's state before the step
    task/...            what the environment remembers besides: the corridor's gaps, a target
    metrics/...         the environment's, before the step
    action [A]          in [-1, 1]; `reward` of the step that it began; `value` of the observation
    memory/...          of a recurrent network, before the step
    network/MODULE      what each module of a Flax network returned: `network/policy/Dense_0` is a
                        layer before its activation, `network/policy` the last one after it; a
                        part of what it returned is named after a dot, `network/head.scale`

MuJoCo's model, to compute from `qpos` where limbs are, is `run.setup.env.physics.model`, `run` as
in `main`. What a module does inside Flax's own loops (`nn.scan`, `nn.vmap`) cannot be noted.
"""

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import numpy as np

from purerl.core.errors import UserError
from purerl.core.keys import Purpose, derive
from purerl.core.records import Array, TrainState
from purerl.devices.compilation import set_up_jax
from purerl.ppo.evaluation import Progress, advance, start
from purerl.ppo.rollout import act
from purerl.runs import build_experiment, run_folder, state_arrays
from purerl.runs.command_errors import leave
from purerl.runs.files import output_file


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
            output, memory = act(network, state.params, state.normalizer, now.env, now.memory)
        action = config.action_distribution.to_action(output.distribution.loc)
        following, reward = advance(config, env, now, action, memory)
        return following, {
            "running": ~(now.over | following.lost),
            "observation": now.env.observation,
            "physics": now.env.physics,
            "metrics": now.env.metrics,
            "task": now.env.task,
            "action": action,
            "reward": reward,
            "value": output.value,
            "memory": now.memory,
            "network": noted,
        }

    steps = math.ceil(config.episode_length / config.action_repeat)
    return jax.lax.scan(step, start(config, env, state, reset_key, number), length=steps)[1]


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


def main(arguments: list[str]) -> int:
    """Writes the file and tells what is in it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="the run's folder")
    parser.add_argument("--out", type=output_file, default="episodes.npz", help="file to write")
    parser.add_argument("--episodes", type=int, default=8, help="N")
    parser.add_argument("--seed", type=int, default=0, help="of the episodes")
    parser.add_argument("--checkpoint", default="latest", help="or best, or an update's number")
    parser.add_argument("--engine", default="", help="where it should not be the run's own")
    options = parser.parse_args(arguments)
    if options.episodes < 1:
        raise UserError(f"episodes is {options.episodes}; it must be at least 1.")
    set_up_jax(cache=True)
    run = run_folder.restore(options.run, options.checkpoint, print, options.engine)
    arrays = record(run.setup, run.saved.state, options.seed, options.episodes)
    with Path(options.out).open("wb") as file:  # by its name, numpy would give it another
        np.savez(file, **arrays)
    for name, array in arrays.items():
        print(f"{name:32} {array.dtype} {list(array.shape)}")
    print(options.out)
    return 0


if __name__ == "__main__":
    leave(lambda: main(sys.argv[1:]))
