"""A few kills at random moments; `python -m tests.long.kills` makes as many as you like."""

import pytest

from tests import quick
from tests.long.kills import kill_many
from tests.training.test_run import TOY

LONG = [str(TOY), "--ppo.num-steps", "4800", "--checkpoints", "15"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "kills"),
    [(LONG, 2), ([*LONG, "--num-seeds", "3", "--keep", "1"], 2)],
    ids=["one run", "vmapped seeds"],
)
def test_killed_runs_end_as_undisturbed_ones(tmp_path, monkeypatch, words, kills):
    monkeypatch.setenv(
        "XLA_FLAGS", quick.FLAGS
    )  # of the processes that are killed, and of the others
    assert kill_many(words, kills, seed=5, runs=tmp_path / "runs")
