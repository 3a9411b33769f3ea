"""Trains a MuJoCo Playground task as Playground does: brax's PPO with its published settings.

    python -m purerl.experiments.peers.playground_training CartpoleSwingup --seed 0 --steps 5000000

A line of JSON for each evaluation: steps, return, its deviation over episodes, seconds since the
start. brax makes whole rounds of updates, so it may make more steps than are asked for. Needs brax
and the extra `playground`.
"""

import argparse
import functools
import json
import time

from brax.training.agents.ppo import networks, train
from mujoco_playground import registry, wrapper
from mujoco_playground.config import dm_control_suite_params

from purerl.experiments.peers.brax_peer import lend_removed_function


def main() -> None:
    """Trains, and prints each evaluation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", help="a task of Playground's control suite")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=5_000_000)
    parser.add_argument("--evaluations", type=int, default=6)
    options = parser.parse_args()
    lend_removed_function()
    settings = dict(dm_control_suite_params.brax_ppo_config(options.task))
    widths = settings.pop("network_factory", {})
    settings |= {"num_timesteps": options.steps, "num_evals": options.evaluations}
    begun = time.monotonic()

    def told(steps: int, metrics: dict) -> None:
        keys = {"return": "eval/episode_reward", "deviation": "eval/episode_reward_std"}
        figures = {name: round(float(metrics[key]), 1) for name, key in keys.items()}
        seconds = round(time.monotonic() - begun, 1)
        print(json.dumps({"steps": int(steps), **figures, "seconds": seconds}), flush=True)

    def build():
        return registry.load(options.task, config_overrides={"impl": "jax"})

    train.train(
        environment=build(),
        eval_env=build(),
        wrap_env_fn=wrapper.wrap_for_brax_training,
        network_factory=functools.partial(networks.make_ppo_networks, **widths),
        progress_fn=told,
        seed=options.seed,
        **settings,
    )


if __name__ == "__main__":
    main()
