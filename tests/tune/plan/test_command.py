"""`python -m purerl.plan`: episodes, two rewards, files, mistakes."""

import csv
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl import load, run
from purerl.core.errors import INTERRUPTED
from purerl.core.keys import Purpose, derive, per_environment
from purerl.plan import main
from purerl.tune.plan import figures
from tests.tune.plan.toys import Point

ROOT = Path(__file__).parent.parent.parent.parent
SMALL = ["--samples", "8", "--horizon", "10", "--knots", "3", "--steps", "20"]

pytestmark = pytest.mark.usefixtures("compiled_quickly")


def test_a_table_of_two_groups_compares_episode_by_episode():
    a = {"episode_return": np.arange(6.0), "only": np.ones(6)}
    b = {"episode_return": np.arange(6.0) + 2.0}
    lines = figures.table({"a": a, "b": b})
    assert lines[0].split() == ["a", "b", "difference"]
    said = "episode_return 2.5 [1.167, 3.833] 4.5 [3.167, 5.833] 2 [2, 2]"
    assert lines[1].split() == said.split()
    assert lines[2].split() == ["only", "1", "[1,", "1]"]


def group(number, **more):
    zeros, lengths = np.zeros(number), np.full(number, 20.0)
    return {"episode_return": zeros, "episode_length": lengths, "lost": zeros} | more


def test_notes_tell_of_few_lost_and_one_step_episodes():
    assert len(figures.notes({"a": group(5)})) == 1
    few, lost, short = (
        figures.notes({"a": x})[-1]
        for x in (
            group(2),
            group(5, lost=np.array([1.0, 0, 0, 1.0, 0])),
            group(5, episode_length=np.ones(5)),
        )
    )
    assert few == "Intervals need 5 episodes: --episodes 5"
    assert lost.startswith("a: 2 of 5 episodes were lost")
    assert short == "a: every episode ended with its first step."


def test_a_judge_counts_what_belongs_to_the_episode_and_to_its_own():
    running = np.array([[True, True], [True, False]])
    parts = {
        "return": np.array([[1.0, 2.0], [3.0, np.nan]]),
        "reward_run": np.full((2, 2), 3.0),
        "over": np.zeros((2, 2), bool),
    }
    rows = [{"running": running, "judged": {"b": parts}}] * 2
    found = figures.judged(rows)
    assert found["return under b"].tolist() == [8.0, 4.0]
    assert found["reward_run under b"].tolist() == [3.0, 3.0]  # a mean over its steps
    assert found["steps under b"].tolist() == [4.0, 2.0]
    # Its own end, in the first episode's second step: that step counts, no later one does.
    ended = {"b": parts | {"over": np.array([[False, False], [True, False]])}}
    found = figures.judged([{"running": running, "judged": ended}, rows[1]])
    assert found["return under b"].tolist() == [4.0, 4.0]
    assert found["steps under b"].tolist() == [2.0, 2.0]


def test_rewards_of_two_settings_are_not_compared():
    own = {"episode_return": 1, "reward_run": 2, "speed": 3}
    assert figures.compared(own, {"return under a": 4}) == {"speed": 3, "return under a": 4}
    assert figures.compared(own, {}) == own


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["cartpole_swingupp"], "There is no experiment 'cartpole_swingupp'"),
        (["--samples", "8"], "The first word must be an experiment or a run"),
        (["cartpole_swingup", "--sample", "8"], "There is no option --sample. Did you mean --samp"),
        (["cartpole_swingup", "--knots", "1"], "knots is 1; it must be at least 2."),
        (["cartpole_swingup", "--episodes", "0"], "episodes is 0; it must be at least 1."),
        (["cartpole_swingup", "--csv", "no/such.csv"], "no/such.csv cannot be written: is "),
        (["cartpole_swingup", "--csv", "tests"], "tests cannot be written: is "),
        (["cartpole_swingup", "--csv", "a", "--json", "a"], "csv and json are both a"),
        (["cartpole_swingup", "--no-policy"], "is an experiment: --no-policy is for a run's"),
        (
            ["cartpole_swingup", "--checkpoint", "3"],
            "is an experiment: --checkpoint is for a",
        ),
        (["cartpole_swingup", "--against"], "The settings after --against are those before it"),
        (
            ["cartpole_swingup", "--against", "--env.substeps", "2"],
            "The settings after --against are those before it",
        ),
        (["cartpole_swingup", "--against", "--seed", "2"], "everything else comes before it"),
        (["cartpole_swingup", "--against", "--sed", "2"], "There is no option --sed."),
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
    whole = json.loads(file.read_text())
    assert whole["environments"]["second"]["velocity_scale"] == 1.0
    found = whole["figures"]
    for title in ("first", "second"):
        own = found[title]["episode_return"]["values"]
        assert found[title][f"return under {title}"]["values"] == pytest.approx(own, rel=1e-5)
        other = ({"first", "second"} - {title}).pop()
        assert found[title][f"return under {other}"]["values"] != pytest.approx(own, rel=1e-3)
        assert found[title]["episode_length"]["values"] == [20.0] * 5
    assert "second: --env.velocity-scale 1.0" in said and "difference" in said
    assert "upright" in said and "Intervals need" not in said and "otherwise" not in said
    rows = list(csv.DictReader(table.open()))
    assert [row["settings"] for row in rows] == ["first"] * 5 + ["second"] * 5


@pytest.mark.slow
def test_settings_that_shape_the_start_are_told(capsys):
    words = ["cartpole_swingup", *SMALL, "--against", "--env.reset-noise", "0.2"]
    assert main(words) == 0
    assert "The two settings begin their episodes otherwise" in capsys.readouterr().out


@pytest.mark.slow
def test_a_plan_stands_beside_the_policy_that_it_corrects(tmp_path, capsys):
    words = ["cartpole_swingup", "--ppo.num-steps", "8192", "--evaluation.number", "0"]
    assert run.main([*words, "--runs", str(tmp_path), "--name", "one"]) == 0
    folder, file = tmp_path / "cartpole_swingup" / "one", tmp_path / "a.json"
    assert main([str(folder), *SMALL, "--episodes", "2", "--json", str(file)]) == 0
    assert f"{folder}, update 2 (8,192 steps)" in capsys.readouterr().out
    found = json.loads(file.read_text())["figures"]
    env, policy = load(folder).env, load(folder).policy
    key = jax.random.split(derive(jax.random.key(0), Purpose.EVALUATION))[0]
    for number, planned in enumerate(found["policy"]["episode_return"]["values"]):
        state = jax.jit(env.reset)(per_environment(key, jnp.arange(2))[number])
        total = 0.0
        for _ in range(20):
            state = jax.jit(env.step)(state, policy(state.observation))
            total += float(state.reward)
        assert planned == pytest.approx(total, rel=1e-3)
    assert set(found) == {"policy", "predictive_sampling + policy"}


@pytest.mark.slow
def test_a_signal_ends_a_plan_in_one_line():
    words = [sys.executable, "-u", "-m", "purerl.plan", "cartpole_swingup", "--episodes", "5"]
    process = subprocess.Popen(
        [*words, "--samples", "8", "--steps", "100000"],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    said = next(process.stdout)  # it plans, and says how it goes
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == INTERRUPTED and "steps planned/s" in said
    first, last = errors.strip().splitlines()
    assert first.startswith("SIGINT: stopping") and last.startswith("purerl: Stopped (")


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
