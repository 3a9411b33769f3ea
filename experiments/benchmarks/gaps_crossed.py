r"""How many gaps a policy crosses in corridors that it has never seen, beside simpler policies.

    python -m purerl.experiments.benchmarks.gaps_crossed runs/rodent_gaps/seed1 \
        --floor-run runs/rodent_run/seed1

The floor policy is one trained without gaps: put into the corridor, it does not see them (what
lies ahead stands at the end of the observation, and is cut off). "Still" holds all actions at 0.
"Whole" is the share of episodes that last up to the time limit, without a fall; one that reaches
the corridor's end before is not counted.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.errors import UserError
from purerl.core.keys import Purpose, derive
from purerl.core.records import Array, Network, Normal, PolicyOutput, TrainState
from purerl.devices.compilation import set_up_jax
from purerl.experiment import objects
from purerl.machine.command_errors import leave
from purerl.ppo.evaluation import evaluate_policy
from purerl.runs import restored_run


def gaps_of(setup: objects.Setup, state: TrainState, seed: int, episodes: int) -> dict[str, Any]:
    """Evaluates deterministically in `episodes` corridors; the same seed gives the same ones."""

    def judge(state: TrainState, key: Array) -> dict[str, Array]:
        length = setup.config.episode_length
        return evaluate_policy(setup.env, setup.network, state, key, episodes, length)

    key = derive(jax.random.key(seed), Purpose.EVALUATION)
    return jax.device_get(jax.jit(judge)(state, key))


def count_features(state: TrainState) -> int:
    """O: how many features a policy observes."""
    return state.normalizer.mean.value.shape[-1]


def blind(network: Network, size: int) -> Network:
    """Lets a network of `size` observation features act on observations with more at the end."""
    return Network(
        network.init,
        lambda params, observation, carry: network.apply(params, observation[..., :size], carry),
    )


def widen(state: TrainState, extra: int) -> TrainState:
    """Gives a state's observation statistics `extra` features that nothing reads."""
    pad = lambda x: jnp.pad(x, (0, extra), constant_values=1.0)  # noqa: E731
    statistics = state.normalizer
    mean, variance = jax.tree.map(pad, (statistics.mean, statistics.variance))
    return state.replace(normalizer=statistics.replace(mean=mean, variance=variance))


def still(action_size: int) -> Network:
    """A network whose deterministic action is 0."""

    def apply(params: Any, observation: Array, carry: Any) -> tuple[PolicyOutput, Any]:
        zero = jnp.zeros((*observation.shape[:-1], action_size))
        return PolicyOutput(Normal(zero, zero + 1.0), observation[..., 0] * 0.0), carry

    return Network(lambda key: ((), ()), apply)


def report(name: str, result: dict[str, Any], limit: int) -> str:
    """Formats one policy's distribution of gaps crossed; `limit` [control steps] of an episode."""
    gaps = result["gaps_crossed_count"]
    quantiles = np.quantile(gaps, [0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0])
    figures = " | ".join(f"{q:.0f}" for q in quantiles)
    some, five = np.mean(gaps >= 1), np.mean(gaps >= 5)
    whole, speed = np.mean(result["episode_length"] == limit), result["forward_velocity"].mean()
    shares = f"{some:.0%} | {five:.0%} | {whole:.0%}"
    return f"| {name} | {gaps.mean():.1f} | {shares} | {figures} | {speed:.2f} |"


def main(arguments: list[str]) -> int:
    """Prints a table of all policies."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="a run in a corridor")
    parser.add_argument("--floor-run", type=Path, help="a run of the same body on a floor")
    parser.add_argument("--episodes", type=int, default=128, help="corridors")
    parser.add_argument("--seed", type=int, default=12345, help="draws the corridors")
    parser.add_argument("--engine", default="", help="where it should not be the run's own")
    options = parser.parse_args(arguments)
    set_up_jax(cache=True)
    trained = restored_run.restore(options.run, "latest", print, options.engine)
    setup, state = trained.setup, trained.saved.state
    if "gaps_crossed_count" not in jax.eval_shape(setup.env.reset, jax.random.key(0)).metrics:
        raise UserError(f"{options.run} runs where there are no gaps; give a run in a corridor.")
    policies = {"trained": (setup, state)}
    if options.floor_run:
        floor = restored_run.restore(options.floor_run, "latest", print, options.engine)
        size = count_features(floor.saved.state)
        extra = count_features(state) - size
        network = blind(floor.setup.network, size)
        policies["floor"] = setup._replace(network=network), widen(floor.saved.state, extra)
    policies["still"] = setup._replace(network=still(setup.env.action_size)), state
    limit = setup.config.episode_length
    seconds = limit * setup.env.control_timestep
    print(f"{options.episodes} corridors, at most {seconds:.0f} s each, deterministic policies")
    shares, quantiles = ">= 1 | >= 5 | whole", "min | 10% | 25% | 50% | 75% | 90% | max"
    print(f"| policy | gaps, mean | {shares} | {quantiles} | m/s |\n|" + "---|" * 13)
    for name, (policy, its_state) in policies.items():
        result = gaps_of(policy, its_state, options.seed, options.episodes)
        print(report(name, result, limit), flush=True)
    return 0


if __name__ == "__main__":
    leave(lambda: main(sys.argv[1:]))
