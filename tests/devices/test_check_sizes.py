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


@pytest.mark.parametrize(
    ("recurrent", "envs", "length", "cure"),
    [
        (False, 1, 32, "num_minibatches could be 16 or a divisor of it, or raise num_envs * roll"),
        (False, 7, 1, "num_minibatches could be 1 or a divisor of it, or raise num_envs * rollout"),
        (False, 1, 1, "would never move; raise num_envs * rollout_length."),
        (True, 9, 1, "num_minibatches could be 3 or a divisor of it, or raise num_envs * rollout"),
        (True, 1, 1, "would never move; raise num_envs * rollout_length."),
    ],
)
def test_a_minibatch_of_one_step_is_refused(recurrent, envs, length, cure):
    """Its advantage less its own mean is 0: such a run trained nothing, and said nothing."""
    sizes = {"num_envs": envs, "rollout_length": length, "num_minibatches": envs * length}
    said = unfit(recurrent, **sizes)
    assert f"num_minibatches = {envs * length} leaves each minibatch one step" in said
    assert cure in said


def test_two_steps_are_enough():
    config = Config(num_envs=1, rollout_length=2, num_minibatches=1, num_steps=2)
    check_minibatches(config, True, 1)


@pytest.mark.timeout(20)
def test_the_sizes_of_a_huge_rollout_are_found_at_once():
    """One after another, 2**31 numbers took minutes."""
    said = unfit(False, num_envs=2**16, rollout_length=2**14, num_minibatches=3, num_steps=2**53)
    assert "num_minibatches could be 1, 2, 4" in said
