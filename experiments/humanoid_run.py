"""The control suite's humanoid runs: eight epochs, and LayerNorm before each activation.

python -m purerl.run humanoid_run --engine jax --seed 0

Expected: return 534 of 1000 after 73 M steps, this seed, 14 min on a third of an H200; it gets up
within 2 s and runs at 5 m/s. With four epochs it begins after 36 M steps, and has 392 after 80 M.
`suite_humanoid` has 304. Walking and standing were not tried: lab/2026-11-30-eight-epochs.md.
"""

import dataclasses
import math

import flax.linen as nn
import jax
import jax.numpy as jnp

from purerl import Array, Network, Normal, PolicyOutput, networks
from purerl.envs.suite import tasks
from purerl.experiments import suite_gpu


@dataclasses.dataclass(frozen=True)
class Options:
    """Sizes of the network."""

    hidden: tuple[int, ...] = (512, 512)
    """Widths of the policy's hidden layers, and of the value function's."""
    initial_std: float = 1.0
    """Scale of raw actions before training, above `min_std`."""
    min_std: float = 0.1
    """Their least scale, to which what is learned is added."""

    def __post_init__(self) -> None:
        """Raises ValueError for what the default network refuses, too."""
        networks.MlpOptions(
            policy_hidden=self.hidden, initial_std=self.initial_std, min_std=self.min_std
        )


class Tower(nn.Module):
    """As `intention.Tower`, with another initializer; [..., O] to [..., last width]."""

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Returns [..., last width]."""
        for width in self.widths:
            dense = nn.Dense(width, kernel_init=nn.initializers.lecun_uniform())
            x = nn.swish(nn.LayerNorm()(dense(x)))
        return x


class ActorCritic(nn.Module):
    """A tower for the policy and one for the value; the scale is one learned vector."""

    options: Options
    action_size: int

    @nn.compact
    def __call__(self, observation: Array) -> PolicyOutput:
        """Applies both to observations [..., O]."""
        o = self.options
        small = nn.initializers.variance_scaling(1e-2, "fan_in", "uniform")
        loc = nn.Dense(self.action_size, kernel_init=small)(Tower(o.hidden)(observation))
        raw = self.param("scale", nn.initializers.zeros, (self.action_size,))
        scale = jax.nn.softplus(raw + math.log(math.expm1(o.initial_std))) + o.min_std
        value = nn.Dense(1)(Tower(o.hidden)(observation))[..., 0]
        return PolicyOutput(Normal(loc, jnp.broadcast_to(scale, loc.shape)), value)


def build_network(options: Options, observation: Array, action_size: int) -> Network:
    """Builds the network for an observation [O], of which `observation` is an example."""
    return networks.from_linen(ActorCritic(options, action_size), observation)


experiment = dataclasses.replace(
    suite_gpu.experiment,
    env=tasks.Options(task="humanoid-run"),
    build_network=build_network,
    network=Options(),
    ppo=dataclasses.replace(
        suite_gpu.experiment.ppo,
        num_steps=80_000_000,
        num_epochs=8,
        gamma=0.97,
        learning_rate=5e-4,
    ),
)
