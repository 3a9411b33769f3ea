"""Sizes that do not divide each other are told with sizes that do."""

import pytest

from purerl.devices.check_sizes import check_minibatches
from purerl.ppo.config import Config


def unfit(recurrent, **settings):
    sizes = {"num_envs": 6, "rollout_length": 16, "num_minibatches": 3, "num_steps": 6 * 16 * 100}
    config = Config(**sizes | settings)
    with pytest.raises(ValueError) as error:
        check_minibatches(config, recurrent, config.num_envs)
    return str(error.value)


@pytest.mark.parametrize(
    ("recurrent", "minibatches", "words"),
    [
        (False, 7, ("num_minibatches = 7", "num_envs * rollout_length = 96", "6, 8", "91 or 98")),
        (True, 4, ("num_minibatches = 4", "num_envs = 6", "3", "4 or 8", "recurrent")),
    ],
)
def test_minibatches_divide_the_rollout(recurrent, minibatches, words):
    said = unfit(recurrent, num_minibatches=minibatches)
    assert all(word in said for word in words)


@pytest.mark.timeout(20)
def test_the_sizes_of_a_huge_rollout_are_found_at_once():
    """One after another, 2**31 numbers took minutes."""
    said = unfit(False, num_envs=2**16, rollout_length=2**14, num_minibatches=3, num_steps=2**53)
    assert "num_minibatches could be 1, 2, 4" in said
