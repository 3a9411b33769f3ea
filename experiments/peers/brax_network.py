"""brax's network for PPO, with brax's initial weights, as a network of one's own.

`purerl.ppo.networks.mlp` begins near mean 0, with one scale everywhere. brax's policy begins with
ordinary weights in its last layer, so that it acts otherwise in each state, and with scales around
0.69: on brax's ant that came to more after 31 M steps (`docs/measurements/peers.md`).
"""

from dataclasses import dataclass

import flax.linen as nn
import jax
import jax.numpy as jnp

from purerl.core.records import Array, Network, Normal, PolicyOutput
from purerl.ppo.checks import check_observation
from purerl.ppo.networks import from_linen

MIN_SCALE = 1e-3


@dataclass(frozen=True)
class Options:
    """Widths of the hidden layers."""

    policy_hidden: tuple[int, ...] = (32,) * 4
    """Of the policy."""
    value_hidden: tuple[int, ...] = (256,) * 5
    """Of the value function."""


class Tower(nn.Module):
    """Dense layers with swish between them; LeCun's uniform weights."""

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Returns [..., last width]."""
        for i, width in enumerate(self.widths):
            x = nn.swish(x) if i else x
            x = nn.Dense(width, kernel_init=nn.initializers.lecun_uniform(), name=f"hidden_{i}")(x)
        return x


class ActorCritic(nn.Module):
    """A tower for the policy, whose scales depend on the observation, and one for the value."""

    options: Options
    action_size: int

    @nn.compact
    def __call__(self, observation: Array) -> PolicyOutput:
        """Applies both to observations [..., O]."""
        policy = Tower((*self.options.policy_hidden, 2 * self.action_size), name="policy")
        loc, raw = jnp.split(policy(observation), 2, axis=-1)
        value = Tower((*self.options.value_hidden, 1), name="value")(observation)[..., 0]
        return PolicyOutput(Normal(loc, jax.nn.softplus(raw) + MIN_SCALE), value)


def build(options: Options, observation: Array, action_size: int) -> Network:
    """Builds it for one `observation` [O] and `action_size` A."""
    check_observation(observation)
    return from_linen(ActorCritic(options, action_size), observation)
