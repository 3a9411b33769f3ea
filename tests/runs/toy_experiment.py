"""Follow a cue with a tiny network: an experiment that trains in a second."""

from dataclasses import dataclass

from purerl.experiment.definition import Experiment
from purerl.ppo.config import Config, Evaluation
from purerl.ppo.networks import MlpOptions, mlp
from tests.ppo.probes import Probe


@dataclass(frozen=True)
class EnvOptions:
    name: str = "both"
    """Which probe."""
    steps: int = 4
    """Steps of an episode."""


def build_env(options: EnvOptions, engine: str) -> Probe:
    return Probe(options.name, options.steps, options.steps)


experiment = Experiment(
    build_env=build_env,
    env=EnvOptions(),
    build_network=mlp,
    network=MlpOptions(policy_hidden=(8,), value_hidden=(8,)),
    ppo=Config(
        num_steps=399,
        num_envs=8,
        rollout_length=4,
        num_epochs=1,
        num_minibatches=2,
        episode_length=10,
    ),
    evaluation=Evaluation(num_episodes=4, number=2),
)
