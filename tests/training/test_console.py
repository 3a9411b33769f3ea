"""What a person is told of a run before it begins."""

import pytest

from purerl.ppo.config import Config
from purerl.training.console import engine_remark, training_episodes


@pytest.mark.parametrize(
    ("engine", "device", "said"),
    [
        ("jax", {"platform": "cpu", "threads": 2}, "set NPROC=1"),
        ("jax", {"platform": "cpu", "threads": 4}, ""),
        ("jax", {"platform": "cpu", "threads": 1}, ""),
        ("jax", {"platform": "gpu"}, ""),
        ("c", {"platform": "cpu", "threads": 2}, ""),
        ("warp", {"platform": "gpu"}, "take a minute"),
        ("warp", {"platform": "cpu", "threads": 1}, "for tests only: take engine c"),
    ],
)
def test_the_line_of_an_engine_tells_what_may_stop_or_take_long(engine, device, said):
    """Engine jax on two of XLA's threads waited for ever; on one, three and four it did not."""
    remark = engine_remark(engine, device)
    assert (said in remark) if said else remark == ""


@pytest.mark.parametrize(
    ("shortest", "said"), [(0, ""), (32, "32 to 1,000 steps in training"), (1000, "")]
)
def test_training_episodes_of_many_lengths_are_told(shortest, said):
    """Else the return on the screen, of short episodes, looks broken beside an evaluation's."""
    line = training_episodes(Config(num_steps=10_000, shortest_episode=shortest))
    assert (said in line) if said else line == ""
