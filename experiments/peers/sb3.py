"""Other trainers beside this one, on the same body: steps per second of whole training.

    python -m pip install -c constraints.txt -e '.[peers]'
    python -m purerl.experiments.peers.sb3 --json lab/data/peers_sb3.json

Both train Gymnasium's Ant-v5 on the CPU: stable-baselines3's PPO steps Gymnasium's environment,
purerl `envs/gymnasium_ant.py`, which a test compares with it. Three settings:

    usual    each trainer as its users run it: stable-baselines3's defaults (64-64 tanh, 2048 steps
             of each environment, minibatches of 64, 10 epochs) with 1 or 8 environments; purerl's
             `gymnasium_ant` (128-128 swish, 256 environments, minibatches of 1024, 4 epochs)
    sb3      both with stable-baselines3's network, minibatch and epochs, and 16,384 samples
    purerl   both with purerl's network, minibatch and epochs, and 8192 samples

Equal is all that decides the learner's work; the number of environments that step together is each
trainer's own. A round is whole updates (acting and learning, no evaluation and no checkpoint, of
either); all take turns, and the median of the rounds counts. purerl normalizes observations here,
stable-baselines3, as by default, does not.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax

from purerl.experiment import objects
from purerl.experiments.benchmarks.benchmark import Part, Timing, measure
from purerl.experiments.benchmarks.output import output_file
from purerl.experiments.peers.gymnasium_ant import experiment
from purerl.machine.command_errors import leave
from purerl.ppo import algorithm
from purerl.ppo.config import Config
from purerl.ppo.networks import MlpOptions


class Sizes(NamedTuple):
    """What decides the learner's work."""

    hidden: tuple[int, ...]  # of the policy and of the value function
    activation: str
    samples: int  # of one update, all environments together
    minibatch: int
    epochs: int


SB3_SIZES = Sizes((64, 64), "tanh", 16384, 64, 10)
PURERL_SIZES = Sizes((128, 128), "swish", 8192, 1024, 4)
NUM_ENVS = experiment.ppo.num_envs  # of purerl
PEER_ENVS = 8  # of stable-baselines3, where it has several


@dataclass
class Ours:
    """purerl's training; a call is one update."""

    update: Callable
    state: Any

    def __call__(self) -> Any:
        """Trains on; returns the update's metrics, fetched as a run fetches them."""
        self.state, metrics = self.update(self.state)
        return jax.device_get(metrics)


def our_config(sizes: Sizes) -> Config:
    """Returns PPO's settings with the given sizes of the learner's work."""
    return replace(
        experiment.ppo,
        rollout_length=sizes.samples // NUM_ENVS,
        num_minibatches=sizes.samples // sizes.minibatch,
        num_epochs=sizes.epochs,
    )


def our_network(sizes: Sizes) -> MlpOptions:
    """Returns the network of the given sizes."""
    options: Any = {"policy_hidden": sizes.hidden, "value_hidden": sizes.hidden}
    return MlpOptions(activation=sizes.activation, **options)  # type: ignore[arg-type]


def ours(sizes: Sizes) -> Part:
    """Compiles purerl's training and makes its first update."""
    chosen = replace(experiment, ppo=our_config(sizes), network=our_network(sizes))
    config, env, network, engine = objects.build(chosen)
    state = jax.jit(partial(algorithm.init, config, env, network))(jax.random.key(chosen.seed))
    update = jax.jit(partial(algorithm.update, config, env, network), donate_argnums=0)
    trainer = Ours(update, state)
    trainer()
    name = f"purerl, engine {engine}, {config.num_envs} environments"
    return Part(name, trainer, config.steps_per_update, 0.0, 0)


@dataclass
class Peer:
    """stable-baselines3's training; a call is one update."""

    model: Any
    samples: int

    def __call__(self) -> None:
        """Trains on."""
        self.model.learn(self.samples, reset_num_timesteps=False)


def sb3(sizes: Sizes, num_envs: int, processes: bool, threads: int) -> Part:
    """Makes stable-baselines3's training and its first update; the rest is its default.

    Args:
      sizes: of the learner's work.
      num_envs: environments that step together.
      processes: whether each has a process of its own.
      threads: of PyTorch.
    """
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    kind = SubprocVecEnv if processes else DummyVecEnv
    activation = {"tanh": torch.nn.Tanh, "swish": torch.nn.SiLU}[sizes.activation]
    model = PPO(
        "MlpPolicy",
        make_vec_env("Ant-v5", n_envs=num_envs, seed=1, vec_env_cls=kind),
        n_steps=sizes.samples // num_envs,
        batch_size=sizes.minibatch,
        n_epochs=sizes.epochs,
        policy_kwargs={"net_arch": list(sizes.hidden), "activation_fn": activation},
        device="cpu",
    )
    torch.set_num_threads(threads)  # of the process: all peers of one table share it
    trainer = Peer(model, sizes.samples)
    trainer()
    name = f"stable-baselines3, {num_envs} x {kind.__name__}"
    return Part(name, trainer, sizes.samples, 0.0, 0)


def make_parts(setting: str, threads: int) -> list[Part]:
    """Makes the trainers of one setting, purerl first."""
    if setting == "usual":
        one = SB3_SIZES._replace(samples=SB3_SIZES.samples // PEER_ENVS)
        several = [sb3(SB3_SIZES, PEER_ENVS, processes, threads) for processes in (False, True)]
        return [ours(PURERL_SIZES), sb3(one, 1, False, threads), *several]
    sizes = {"sb3": SB3_SIZES, "purerl": PURERL_SIZES}[setting]
    several = [sb3(sizes, PEER_ENVS, processes, threads) for processes in (False, True)]
    return [ours(sizes), *several]


def close(parts: Iterable[Part]) -> None:
    """Ends the peers' processes."""
    for part in parts:
        if isinstance(part.call, Peer):
            part.call.model.get_env().close()


def table(setting: str, timings: list[Timing]) -> str:
    """Formats one setting; the ratio is purerl's rate over each peer's."""
    lines = [f"| {setting} | s/update | steps/s | purerl is faster by |", "|---|---|---|---|"]
    for t in timings:
        ratio = timings[0].steps_per_second / t.steps_per_second
        lines.append(f"| {t.name} | {t.seconds:.3f} | {t.steps_per_second:,.0f} | {ratio:.1f} |")
    return "\n".join(lines)


def main(arguments: list[str]) -> int:
    """Measures the settings that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    settings = ("usual", "sb3", "purerl")
    parser.add_argument("--settings", nargs="+", choices=settings, default=settings)
    parser.add_argument("--rounds", type=int, default=3, help="rounds of the measurement")
    parser.add_argument("--least-s", type=float, default=3.0, help="least time of a round [s]")
    parser.add_argument("--torch-threads", type=int, default=1, help="threads of PyTorch")
    parser.add_argument(
        "--json", type=output_file, default="", help="also write the figures to this file"
    )
    options = parser.parse_args(arguments)
    found = {}
    for setting in options.settings:
        parts = make_parts(setting, options.torch_threads)
        timings = measure(parts, options.rounds, options.least_s)
        close(parts)
        print(table(setting, timings), flush=True)
        found[setting] = [timing._asdict() for timing in timings]
    if options.json:
        with open(options.json, "w") as file:
            json.dump({"torch_threads": options.torch_threads, "settings": found}, file, indent=1)
    return 0


if __name__ == "__main__":
    leave(lambda: main(sys.argv[1:]))
