"""A run that cannot go on says whose fault it is: the policy's, the environment's or the rate's."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from purerl.core.records import Normal, PolicyOutput
from purerl.runs.metrics_file import MAX_SKIPPED_IN_A_ROW
from purerl.training import loop

SPREAD = object()  # over several devices, where a state has no environments of its own
NAN = float("nan")


def why(loc=0.0, scale=1.0, observation=0.0, seeds=1, losses=(), **record):
    """Returns what is said of the last seed; a policy of the others is well."""
    policy = Normal(*(np.full((4, 2), x, np.float32) for x in (loc, scale)))
    own = {name: np.full(4, x) for name, x in dict(losses).items()}
    policy = PolicyOutput(policy, np.zeros(4), own)
    state = SimpleNamespace(env_state={"observation": np.full((4, 3), observation, np.float32)})
    if seeds > 1:
        well = PolicyOutput(Normal(np.zeros((4, 2)), np.ones((4, 2))), np.zeros(4))
        well = well._replace(losses={name: np.zeros(4) for name in own})
        policy = jax.tree.map(lambda *each: np.stack(each), well, policy)
    programs = SimpleNamespace(fetch={SPREAD: state}.get, policy=lambda state: policy)
    sound = {"train/parameter_norm": 1.0, "train/reward": 0.0, "train/skipped_in_a_row": 0.0}
    records = [sound] * (seeds - 1) + [sound | {f"train/{k}": x for k, x in record.items()}]
    reasons = [loop._why_lost(programs, SPREAD, records, seed) for seed in range(seeds)]
    assert not any(reasons[:-1])
    return reasons[-1]


@pytest.mark.parametrize("seeds", [1, 2])
@pytest.mark.parametrize("scale", [0.0, 1e-7, -1.0, np.inf, NAN])
def test_a_scale_that_is_none_is_named(scale, seeds):
    said = why(scale=scale, seeds=seeds, skipped_in_a_row=MAX_SKIPPED_IN_A_ROW)
    assert f"its scale {scale:.3g} to {scale:.3g}" in said
    assert "learning_rate" not in said and "reward" not in said


def test_a_policy_that_is_no_number_is_not_the_environments_fault():
    """Its actions lose every state, and each begins anew."""
    assert "The policy's loc is nan to nan" in why(loc=NAN, reward=NAN)


def test_whatever_else_is_lost_is_no_fault_of_the_policy():
    assert "Lower ppo.learning_rate" in why(skipped_in_a_row=MAX_SKIPPED_IN_A_ROW)
    assert "No step of an update was sound" in why(reward=NAN)
    said = why(loc=NAN, observation=NAN, reward=NAN)
    assert "No step of an update was sound" in said and "observation" in said
    assert why() == why(scale=0.0) == ""


@pytest.mark.parametrize("seeds", [1, 2])
def test_a_loss_of_the_networks_own_that_is_no_number_is_named(seeds):
    last = {"seeds": seeds, "skipped_in_a_row": MAX_SKIPPED_IN_A_ROW}
    said = why(losses={"code_kl": NAN, "guess": 1.0}, **last)
    assert "The network's loss code_kl is not finite" in said and "environment" not in said
    well = why(losses={"code_kl": 0.0, "guess": 1.0}, **last)
    assert well.endswith("environment's reward or the network's losses (code_kl, guess).")
    assert "loss code_kl" not in why(losses={"code_kl": NAN}, observation=NAN, **last)
