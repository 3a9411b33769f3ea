"""A setting that a run is resumed with acts, or is refused: none is accepted without effect."""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import pytest

from purerl.core.errors import UserError
from purerl.core.records import Normal, PolicyOutput
from purerl.devices.programs import abstract_state
from purerl.experiment import settings_json
from purerl.experiment.objects import build, check_acts
from purerl.ppo import algorithm, networks
from purerl.ppo.config import Config
from tests.runs.toy_experiment import experiment


class Watched(Config):
    """Settings that note which of them are read."""

    def __getattribute__(self, name):
        READ.add(name)
        return super().__getattribute__(name)


READ: set[str] = set()
NAMES = {field.name for field in dataclasses.fields(Config)}


@dataclasses.dataclass(frozen=True)
class Sizes:
    kernel: float = 1.0  # of the first weights alone
    slope: float = 1.0


class Linear(nn.Module):
    sizes: Sizes

    @nn.compact
    def __call__(self, observation):
        weights = nn.Dense(3, kernel_init=nn.initializers.normal(self.sizes.kernel))
        out = self.sizes.slope * weights(observation)
        return PolicyOutput(Normal(out[..., :1], jnp.exp(out[..., 1:2])), out[..., 2])


def own(sizes: Sizes, observation, action_size):
    return networks.from_linen(Linear(sizes), observation)


def refusal(begun, **changes) -> str:
    """Returns what is said of an experiment that goes on with changes; "" if they act."""
    setup, chosen = build(begun), dataclasses.replace(begun, **changes)
    try:
        before = settings_json.to_json(begun)
        check_acts(chosen, before, setup.env, abstract_state(*setup[:3]))
    except UserError as error:
        return str(error).partition(": ")[0]
    return ""


@pytest.mark.parametrize(
    ("schedule", "unread"),
    [
        ("adaptive_kl", {"learning_rate", "num_steps"}),
        ("constant", {"desired_kl"}),
        ("linear", {"desired_kl"}),
    ],
)
def test_of_the_algorithms_settings_an_update_reads_all_but_those_that_are_told(schedule, unread):
    """The plan reads `num_steps`, too; `check` warns of a `desired_kl` that nothing reads."""
    _, env, network, _ = build(experiment)
    config = Watched(**vars(experiment.ppo) | {"schedule": schedule})
    abstract = abstract_state(config, env, network)
    READ.clear()
    jax.eval_shape(functools.partial(algorithm.update, config, env, network), abstract)
    assert unread == NAMES - READ


def test_a_rate_that_starts_an_adaptive_schedule_is_refused_and_others_act():
    slower = dataclasses.replace(experiment.ppo, learning_rate=1e-5)
    assert refusal(experiment, ppo=slower) == ""
    adaptive = dataclasses.replace(slower, schedule="adaptive_kl")
    assert refusal(experiment, ppo=adaptive) == "ppo.learning_rate"
    begun = dataclasses.replace(experiment, ppo=adaptive)
    assert refusal(begun, ppo=dataclasses.replace(adaptive, num_steps=6400)) == ""


def test_another_seed_is_refused():
    assert refusal(experiment, seed=experiment.seed + 1) == "seed"


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"slope": 2.0}, ""),
        ({"kernel": 2.0}, "network.kernel"),
        ({"kernel": 2.0, "slope": 2.0}, "network.kernel"),
    ],
)
def test_what_a_network_reads_in_init_alone_is_refused(changes, told):
    begun = dataclasses.replace(experiment, build_network=own, network=Sizes())
    assert refusal(begun, network=Sizes(**changes)) == told


@pytest.mark.parametrize(
    "changes", [{"initial_std": 0.5}, {"min_std": 0.1}, {"activation": "tanh"}]
)
def test_all_that_a_default_network_can_change_acts(changes):
    for make, begun in (
        (networks.mlp, networks.MlpOptions(policy_hidden=(8,), value_hidden=(8,))),
        (networks.recurrent, networks.RecurrentOptions(hidden=8, encoder=(8,), value_hidden=(8,))),
    ):
        was = dataclasses.replace(experiment, build_network=make, network=begun)
        assert refusal(was, network=dataclasses.replace(begun, **changes)) == ""
