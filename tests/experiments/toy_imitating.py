"""Follow a cue through a code of `experiments/intention.py`: it trains in a second."""

from dataclasses import dataclass, replace

import jax.numpy as jnp

from purerl import Array, State
from purerl.experiments import intention
from tests.ppo.probes import Probe
from tests.runs import toy_experiment

SMALL = {"code": 3, "decoder": (8,), "prior": (4,)}


@dataclass(frozen=True)
class Feeling:
    """A probe whose observation has the entries that imitation has, or another task."""

    probe: Probe
    told: str  # the entry that has the cue
    size: float = 1.0  # of what is felt: in another task other numbers are usual
    control_timestep: float = 1.0
    action_size: int = 1

    def reset(self, key: Array) -> State:
        return self._split(self.probe.reset(key))

    def step(self, state: State, action: Array) -> State:
        return self._split(self.probe.step(state, action))

    def _split(self, state: State) -> State:
        time = state.task["time"].astype(jnp.float32)
        felt = self.size * jnp.stack([time, jnp.sin(time)])
        return state.replace(observation={self.told: state.observation, "proprioception": felt})


def build_env(options: toy_experiment.EnvOptions, engine: str) -> Feeling:
    return Feeling(toy_experiment.build_env(options, engine), "reference")


experiment = replace(
    toy_experiment.experiment,
    build_env=build_env,
    build_network=intention.imitate,
    network=intention.ImitationOptions(**SMALL, encoder=(8,), value=(8,)),
    ppo=replace(toy_experiment.experiment.ppo, auxiliary={"code_kl": 1e-3, "prior_kl": 1.0}),
)
