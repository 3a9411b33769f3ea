"""Your own Flax network, in this one file: nothing to register.

python -m purerl.run experiments/custom_network.py                    # train
python -m purerl.run experiments/custom_network.py --resume           # go on after a stop
python -m purerl.evaluate runs/custom_network/seed1                   # evaluate
python -m purerl.run experiments/custom_network.py --network.width 128 --name wide
"""

import dataclasses

import flax.linen as nn
import jax.numpy as jnp

from purerl import Array, Config, Experiment, Network, Normal, PolicyOutput, networks
from purerl.envs import cartpole_swingup


@dataclasses.dataclass(frozen=True)
class Options:  # every field becomes a flag: --network.width
    """Settings of the network."""

    width: int = 64
    """Features of the shared layer."""


class Residual(nn.Module):  # any module: observations [..., O] in, PolicyOutput out
    """One shared layer, then a residual block for each of policy and value."""

    options: Options
    action_size: int

    @nn.compact
    def __call__(self, observation: Array) -> PolicyOutput:
        """Applies the network; leading axes are batch axes."""
        shared = nn.tanh(nn.Dense(self.options.width)(observation))
        policy = shared + nn.tanh(nn.Dense(self.options.width)(shared))
        value = shared + nn.tanh(nn.Dense(self.options.width)(shared))
        loc = nn.Dense(self.action_size, kernel_init=nn.initializers.normal(0.01))(policy)
        log_scale = self.param("log_scale", nn.initializers.constant(-0.5), (self.action_size,))
        scale = jnp.broadcast_to(jnp.exp(log_scale), loc.shape)
        return PolicyOutput(Normal(loc, scale), nn.Dense(1)(value)[..., 0])


def build_network(options: Options, observation: Array, action_size: int) -> Network:
    """`observation` is an example, zeros [O]; for memory, see `networks.recurrent`."""
    return networks.from_linen(Residual(options, action_size), observation)


experiment = Experiment(
    build_env=cartpole_swingup.build,
    env=cartpole_swingup.Options(),
    build_network=build_network,
    network=Options(),
    ppo=Config(num_steps=1_000_000),
)
