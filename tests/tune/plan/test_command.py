"""`python -m purerl.plan`: episodes, two rewards, files, mistakes."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from purerl.plan import main
from purerl.tune.plan import figures
from tests.tune.plan.toys import Point

ROOT = Path(__file__).parent.parent.parent.parent
SMALL = ["--samples", "8", "--horizon", "10", "--knots", "3", "--steps", "20"]


def test_a_table_of_two_groups_compares_episode_by_episode():
    a = {"episode_return": np.arange(6.0), "only": np.ones(6)}
    b = {"episode_return": np.arange(6.0) + 2.0}
    lines = figures.table({"a": a, "b": b})
    assert lines[0].split() == ["a", "b", "difference"]
    said = "episode_return 2.5 [1.167, 3.833] 4.5 [3.167, 5.833] 2 [2, 2]"
    assert lines[1].split() == said.split()
    assert lines[2].split() == ["only", "1", "[1,", "1]"]
    few = {"episode_return": np.arange(2.0)}
    assert figures.table({"a": few})[-1] == "Intervals need 5 episodes: --episodes 5"


def test_a_judge_counts_what_belongs_to_the_episode():
    running = np.array([[True, True], [True, False]])
    row = {"running": running, "judged": {"b": np.array([[1.0, 2.0], [3.0, np.nan]])}}
    assert figures.judged([row, row])["return under b"].tolist() == [8.0, 4.0]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["cartpole_swingupp"], "There is no experiment 'cartpole_swingupp'"),
        (["--samples", "8"], "The first word must be an experiment or a run"),
        (["cartpole_swingup", "--sample", "8"], "There is no option --sample. Did you mean --samp"),
        (["cartpole_swingup", "--knots", "1"], "knots is 1; it must be at least 2."),
        (["cartpole_swingup", "--episodes", "0"], "episodes is 0; it must be at least 1."),
        (["cartpole_swingup", "--csv", "no/such.csv"], "must be a file in a folder that exists"),
        (["cartpole_swingup", "--against"], "The settings after --against are those before it"),
        (["cartpole_swingup", "--against", "--seed", "2"], "There is no option --seed."),
        (["tests"], "tests is no run: it has no config.json"),
    ],
)
def test_a_mistake_is_one_line(words, message, capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    assert main(words) == 2
    said = capsys.readouterr().err
    assert message in said and said.startswith("purerl: ") and said.count("\n") == 1


@pytest.mark.slow
def test_two_rewards_judge_both_behaviours(tmp_path, capsys):
    table, file = tmp_path / "a.csv", tmp_path / "a.json"
    words = ["cartpole_swingup", *SMALL, "--episodes", "5", "--csv", str(table)]
    assert main([*words, "--json", str(file), "--against", "--env.velocity-scale", "1"]) == 0
    said = capsys.readouterr().out
    found = json.loads(file.read_text())["figures"]
    for title in ("these settings", "against"):
        own = found[title]["episode_return"]["values"]
        assert found[title][f"return under {title}"]["values"] == pytest.approx(own, rel=1e-5)
        other = ({"these settings", "against"} - {title}).pop()
        assert found[title][f"return under {other}"]["values"] != pytest.approx(own, rel=1e-3)
        assert found[title]["episode_length"]["values"] == [20.0] * 5
    assert "difference" in said and "upright" in said and "Intervals need" not in said
    rows = list(csv.DictReader(table.open()))
    assert [row["settings"] for row in rows] == ["these settings"] * 5 + ["against"] * 5


@pytest.mark.slow
def test_two_processes_have_the_same_bits(tmp_path):
    files = [tmp_path / "a.json", tmp_path / "b.json"]
    for file in files:
        words = ["-m", "purerl.plan", "cartpole_swingup", *SMALL, "--json", str(file)]
        done = subprocess.run([sys.executable, *words], cwd=ROOT, env=os.environ, timeout=200)
        assert done.returncode == 0
    first, second = (json.loads(file.read_text())["figures"] for file in files)
    assert first == second


@pytest.mark.slow
def test_the_cart_pole_swings_up_without_learning(tmp_path):
    file = tmp_path / "a.json"
    assert main(["cartpole_swingup", "--steps", "160", "--json", str(file)]) == 0
    found = json.loads(file.read_text())["figures"]["predictive_sampling"]
    # Standing from some step on: a pole that only swings has half of it.
    assert found["episode_return"]["mean"] > 80.0


def test_toys_keep_the_contract():
    from purerl import check_env

    check_env(Point())
