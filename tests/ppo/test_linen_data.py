"""What a Flax module holds besides its collection `params` is data: no step of Adam moves it."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx
from flax.nnx import bridge

from purerl.checks import examine_network
from purerl.core.records import Normal, PolicyOutput
from purerl.machine.state_arrays import flatten
from purerl.ppo.config import Config
from purerl.ppo.networks import from_linen
from purerl.ppo.optimizer import optimizer
from tests import quick

SEEN = np.random.default_rng(0).normal(size=(8, 3)).astype(np.float32)


class Linen(nn.Module):
    """Data of three kinds, one of them drawn."""

    @nn.compact
    def __call__(self, x):
        x = nn.BatchNorm(use_running_average=True)(x)
        x = nn.SpectralNorm(nn.Dense(4))(x, update_stats=False)
        drawn = lambda: jax.random.normal(self.make_rng("params"), (4,))  # noqa: E731
        x = x * self.variable("constants", "factor", drawn).value
        loc, value = nn.Dense(1)(x), nn.Dense(1)(x)[..., 0]
        return PolicyOutput(
            Normal(loc, jnp.exp(self.param("scale", nn.zeros, (1,))) + 0 * loc), value
        )


class Nnx(nnx.Module):
    def __init__(self, rngs):
        self.first = nnx.Linear(3, 3, rngs=rngs)
        self.norm = nnx.BatchNorm(3, use_running_average=True, rngs=rngs)
        self.factor = nnx.Variable(jnp.full(3, 2.0))

    def __call__(self, x):
        x = self.norm(self.first(x)) * self.factor[...]
        return PolicyOutput(Normal(x[..., :1], jnp.exp(x[..., 1:2])), x[..., 2])


@pytest.mark.parametrize(
    ("module", "data", "trained"),
    [
        (Linen(), {"batch_stats", "constants"}, 33),
        (bridge.to_linen(Nnx), {"batch_stats", "Variable"}, 18),
    ],
    ids=["linen", "nnx"],
)
def test_data_stays_and_is_no_parameter(module, data, trained):
    network = from_linen(module, jnp.zeros(3))

    def loss(params):
        output, _ = network.apply(params, SEEN, ())
        return sum(jnp.square(x + 1.0).sum() for x in jax.tree.leaves(output))

    def two_steps(key):
        adam, begun = optimizer(Config(num_steps=10**6)), network.init(key)[0]
        params, state = begun, adam.init(begun)
        for _ in range(2):
            updates, state = adam.update(jax.grad(loss)(params), state)
            params = optax.apply_updates(params, updates)
        return begun, params

    before, after = quick.jit(two_steps)(jax.random.key(0))
    assert after.keys() == {"params", *data}
    moved = {name for name, x in flatten(after).items() if (x != flatten(before)[name]).any()}
    assert moved == {name for name in flatten(after) if name.startswith("params/")}
    assert sum(x.size for x in jax.tree.leaves(examine_network.trained(after))) == trained


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_quickly")
def test_check_looks_for_gradients_of_parameters_alone():
    found = list(examine_network.examine(from_linen(Linen(), jnp.zeros(3)), SEEN))
    assert {one.level for one in found} == {"ok"}
    assert found[-1].text == "each of 9 parameters has one"
