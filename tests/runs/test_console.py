"""What a person is told of a run before it begins."""

import pytest

from purerl.runs.console import engine_remark


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
