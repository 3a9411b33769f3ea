"""What an experiment builds: its network's answers are float32, whatever it computes in."""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import pytest

from purerl.core.errors import UserError
from purerl.devices.programs import abstract_state
from purerl.experiment.objects import _taken, build
from purerl.ppo import algorithm, networks
from purerl.ppo.networks import RecurrentOptions
from tests.runs.toy_experiment import experiment


def in_half(make, dtype):
    """Returns a builder of the network that computes, and remembers, in another dtype."""

    def cast(tree):
        return jax.tree.map(lambda x: x.astype(dtype), tree)

    def build_network(*arguments):
        whole = make(*arguments)

        def init(key):
            params, memory = whole.init(key)
            return params, cast(memory)

        def apply(params, observation, memory):
            return cast(whole.apply(cast(params), cast(observation), memory))

        return networks.Network(init, apply)

    return build_network


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float16])
@pytest.mark.parametrize("recurrent", [False, True])
def test_a_network_may_compute_in_half_precision(dtype, recurrent):
    options = RecurrentOptions(hidden=8, encoder=(8,), value_hidden=(8,))
    make, options = (
        (networks.recurrent, options) if recurrent else (networks.mlp, experiment.network)
    )
    half = dataclasses.replace(experiment, build_network=in_half(make, dtype), network=options)
    config, env, network, _ = build(half)
    state = abstract_state(config, env, network)
    output, _ = jax.eval_shape(
        network.apply, state.params, state.env_state.observation, state.memory
    )
    assert {x.dtype for x in jax.tree.leaves(output)} == {jnp.dtype("float32")}
    assert {x.dtype for x in jax.tree.leaves(state.memory)} == (
        {jnp.dtype(dtype)} if recurrent else set()
    )
    update = functools.partial(algorithm.update, config, env, network)
    assert jax.eval_shape(update, state)[0] == state, "as it was, so that updates follow each other"


def calling(function):
    """Returns a network from a Flax module whose `__call__` that is."""
    module = type("Mine", (nn.Module,), {"__call__": function})()
    return networks.from_linen(module, jnp.zeros(3))


def plain(apply):
    return networks.Network(lambda key: ({}, ()), apply)


@pytest.mark.parametrize(
    ("network", "drawn", "silent"),
    [
        (calling(lambda self, x: x), "Mine takes (x), and is called as Mine(observation, no", ""),
        (calling(lambda self, x, eps=None: x), "", "Mine takes eps, and there is no Network"),
        (calling(lambda self, x, *given: x), "", ""),
        (calling(lambda self, x, train=False: x), "", ""),
        (calling(lambda self, x, *, mask=None: x), "Mine takes (x, *, mask=None), and", ""),
        (
            plain(lambda p, x, m: x),
            "network.apply takes (p, x, m), and is called as network.ap",
            "",
        ),
        (plain(lambda p, x, m, noise=None: x), "", "network.apply takes noise, and there is"),
        (plain(lambda *given: given), "", ""),
    ],
)
def test_noise_is_drawn_and_taken_or_neither(network, drawn, silent):
    drawing = network._replace(draw=lambda key: jax.random.normal(key, (2,)))
    for one, told in ((drawing, drawn), (network, silent)):
        said = ""
        try:
            assert (
                _taken(one, ())
                == ["params", "observation", "memory", "noise"][: 3 + bool(one.draw)]
            )
        except UserError as error:
            said = str(error)
        assert said.startswith(told) and bool(said) == bool(told)
        assert not said or said.count("docs/howto/network_parts.md") == 1
