"""What the planner returns and how fast it is: the benchmarks' own bookkeeping."""

import csv

import pytest

from purerl.core.errors import UserError
from purerl.experiments.benchmarks import plan_speed, plan_suite
from purerl.tune.plan.settings import Settings

TASK = "cartpole-swingup"
SMALL = {"samples": 4, "horizon": 3, "knots": 2}


@pytest.mark.slow
def test_batches_that_the_file_has_are_not_played_again(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(plan_suite.OTHER_SETTINGS, TASK, SMALL)
    file = tmp_path / "found.csv"
    words = ["plan_suite", "--only", TASK, "--planners", "mppi", "--steps", "20", "--batches", "1"]
    monkeypatch.setattr("sys.argv", [*words, "--out", str(file)])
    assert plan_suite.main() == 0
    rows = list(csv.DictReader(file.open()))
    assert [(r["task"], r["planner"], r["episode"], r["length"]) for r in rows] == [
        (TASK, "mppi", "0", "20"),
        (TASK, "mppi", "1", "20"),
    ]
    assert "N = 2" in capsys.readouterr().out
    played = []
    monkeypatch.setattr(plan_suite, "play", lambda *a: played.append(a) or [])
    assert plan_suite.main() == 0 and played == []
    monkeypatch.setattr("sys.argv", [*words[:-1], "2", "--out", str(file)])
    assert plan_suite.main() == 0
    assert played == [(TASK, "mppi", 20, 1, 2)]  # the second batch, of a seed of its own


def test_a_file_of_another_command_is_one_line(tmp_path, monkeypatch):
    file = tmp_path / "others.csv"
    file.write_text("seed,steps,return\n1,2,3\n")
    monkeypatch.setattr("sys.argv", ["plan_suite", "--table", "--out", str(file)])
    with pytest.raises(UserError, match="has no column planner"):
        plan_suite.main()


@pytest.mark.parametrize("words", [["--batches", "0"], ["--out", "."]])
def test_an_argument_that_nothing_can_come_of_is_refused_before_measuring(words, monkeypatch):
    monkeypatch.setattr("sys.argv", ["plan_suite", "--table", *words])
    with pytest.raises(SystemExit):
        plan_suite.main()


@pytest.mark.parametrize("name", ["mppi", "mppi+policy"])
def test_a_planner_beside_a_policy_has_the_settings_that_it_has_alone(name):
    assert plan_suite.settings_of("hopper-hop", name) == Settings("mppi", noise=1.0)


@pytest.mark.slow
def test_mujoco_alone_steps_the_rows_that_the_plans_stepped(monkeypatch):
    kept = []

    class Recorder(plan_speed.Recorder):
        def alone(self):
            kept.extend(self.asked)
            return super().alone()

    monkeypatch.setattr(plan_speed, "Recorder", Recorder)
    speed = plan_speed.measure(TASK, Settings(**SMALL), side_by_side=2, steps=3)
    sizes = [len(rows) for (_, rows, _, _), _ in kept]
    # Three plans of 3 steps of 2 x 4 samples, and the step that each environment then takes.
    assert sizes == 3 * [8, 8, 8, 2]
    assert speed.share > 0.0
    assert speed.real_time == pytest.approx(speed.plans * 0.01)
