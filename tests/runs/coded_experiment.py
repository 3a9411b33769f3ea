"""Follow a cue through a small code that is drawn: an experiment that trains in a second."""

from dataclasses import dataclass, replace

import flax.linen as nn
import jax
import jax.numpy as jnp

from purerl.core.records import Network, Normal, PolicyOutput
from purerl.experiment.definition import Part
from purerl.ppo.networks import from_linen
from tests.runs import toy_experiment


@dataclass(frozen=True)
class Options:
    code: int = 2
    """Features of the code."""
    hidden: int = 0
    """Features of the memory; 0: none."""
    decoder: int = 8
    """Width of the decoder."""


class Decoder(nn.Module):
    width: int
    action_size: int

    @nn.compact
    def __call__(self, x):
        return nn.Dense(self.action_size)(nn.tanh(nn.Dense(self.width)(x)))


class Coded(nn.Module):
    """Named losses: an information bottleneck, a penalty for codes that are not sparse, a guess."""

    options: Options
    action_size: int

    @nn.compact
    def __call__(self, observation, *given):
        seen = observation
        if self.options.hidden:
            memory, *given = given
            memory, seen = nn.GRUCell(self.options.hidden, name="cell")(memory, observation)
        both = nn.Dense(2 * self.options.code, name="encoder")(seen)
        mean, log_std = jnp.split(both, 2, axis=-1)
        code = mean + jnp.exp(log_std) * given[0] if given else mean
        kl = 0.5 * (jnp.square(mean) + jnp.exp(2 * log_std) - 1.0) - log_std
        guess = nn.Dense(observation.shape[-1], name="guess")(code)
        losses = {
            "code_kl": kl.mean(-1),
            "sparsity": jnp.abs(code).mean(-1),
            "prediction": jnp.square(guess - observation).mean(-1),
        }
        decoder = Decoder(self.options.decoder, self.action_size, name="decoder")
        loc = decoder(jnp.concatenate([code, observation], -1))
        value = nn.Dense(1, name="critic")(seen)[..., 0]
        output = PolicyOutput(Normal(loc, jnp.full_like(loc, 0.5)), value, losses)
        return (output, memory) if self.options.hidden else output


def build_network(options: Options, observation, action_size: int) -> Network:
    memory = jnp.zeros(options.hidden) if options.hidden else ()
    network = from_linen(Coded(options, action_size), observation, memory)
    return network._replace(draw=lambda key: jax.random.normal(key, (options.code,)))


experiment = replace(
    toy_experiment.experiment,
    build_network=build_network,
    network=Options(),
    ppo=replace(
        toy_experiment.experiment.ppo,
        auxiliary={"code_kl": (0.0, 0.1, 200), "sparsity": 0.01, "prediction": 1.0},
    ),
    parts={"decoder": Part()},
)
