"""Whole sweeps: stand-ins for runs; and one of real runs, killed in the middle."""

import csv
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from purerl import sweep
from purerl.core.errors import FAILURE, SUCCESS, USAGE
from purerl.tune.sweep import scheduler, slurm
from tests.long.kills import read_lines
from tests.training.test_run import ROOT, TOY

RATES = ["--grid", "ppo.learning-rate=1e-2,2e-3,9e-4"]


def rows(name: str = "toy_experiment") -> list[dict]:
    with (Path("sweeps") / name / "sweep.csv").open() as file:
        return list(csv.DictReader(file))


def start(*words: str) -> int:
    return sweep.main([str(TOY), "--jobs", "2", *words])


@pytest.mark.slow
def test_the_table_has_the_best_first_and_numbers_as_numbers(place, capsys):
    assert start(*RATES, "--seeds", "5") == SUCCESS
    found = rows()
    assert [row["ppo.learning-rate"] for row in found] == ["2e-3", "9e-4", "1e-2"]
    scores = [3 - (rate - 3e-3) ** 2 for rate in (2e-3, 9e-4, 1e-2)]  # of the middle seeds
    assert [float(row["score"]) for row in found] == pytest.approx(scores)
    for row in found:
        assert row["n"] == "5" and row["status"] == "done"
        assert 1 <= float(row["low"]) < float(row["score"]) < float(row["high"]) <= 5
    assert "3 points (3 done), eval/episode_return at the end" in capsys.readouterr().out
    with Image.open("sweeps/toy_experiment/sweep.png") as picture:
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 20


@pytest.mark.slow
def test_a_point_that_fails_is_counted(place, capsys):
    assert start("--grid", "ppo.gamma=0.9,0.5,0.6", "--seeds", "1") == FAILURE
    found = {row["ppo.gamma"]: row for row in rows()}
    assert found["0.9"]["status"] == "done" and list(found)[0] == "0.9"
    assert found["0.5"]["said"] == "gamma is 0.5. Take another one."
    assert found["0.6"]["said"] == "killed by SIGKILL" and found["0.6"]["n"] == "0"
    said = capsys.readouterr().out
    begun = [line for line in said.splitlines() if "  begins  " in line]
    logs = [Path(line.split("(progress: ")[1].rstrip(")")) for line in begun]
    assert [log.stem for log in logs] == ["p0000", "p0001", "p0002"] and all(map(Path.exists, logs))
    assert "3 points (1 done, 2 failed)" in said and "p0001 failed: gamma is 0.5." in said


@pytest.mark.slow
def test_other_values_under_the_same_name_are_refused(place, capsys):
    assert start(*RATES) == SUCCESS
    before = sorted(Path("sweeps").rglob("*"))
    for words, named in [
        (["--grid", "ppo.learning-rate=1e-2,2e-3,8e-4"], "swept.ppo.learning-rate"),
        ([*RATES, "--seeds", "4"], "seeds: 3 -> 4"),
        ([*RATES, "--ppo.num-steps", "500"], "settings.ppo.num_steps: 399 -> 500"),
        (["--random", "3", "--over", "ppo.learning-rate=1e-2,2e-3,9e-4"], "points: grid -> random"),
    ]:
        capsys.readouterr()
        assert start(*words) == USAGE
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert named in line and "was begun otherwise" in line
    assert sorted(Path("sweeps").rglob("*")) == before
    same = ["--grid", "ppo.learning_rate=0.01,0.002,0.0009"]
    assert start(*same) == SUCCESS  # other words for the same


@pytest.mark.slow
def test_other_options_that_alter_results_are_refused(place, capsys):
    assert start(*RATES) == SUCCESS
    for words, named in [
        (["--portable"], "portable: False -> True"),
        (["--seeds-by", "map"], "seeds_by: vmap -> map"),
        (["--num-shards", "1"], "num_shards: 0 -> 1"),
        (["--log-every", "7"], "log_every: 0 -> 7"),
    ]:
        capsys.readouterr()
        assert start(*RATES, *words) == USAGE
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert f"was begun otherwise: {named}; give" in line


@pytest.fixture
def own(place, monkeypatch):
    """Somebody's experiment, which takes its environment from a module beside it."""
    monkeypatch.syspath_prepend(place)
    text = TOY.read_text()
    assert "return Probe(" in text
    (place / "mine_reward.py").write_text(text)
    (place / TOY.name).write_text(f"from mine_reward import build_env\n{text}".replace(
        "def build_env", "def _unused"))  # fmt: skip
    yield place / TOY.name
    sys.modules.pop("mine_reward", None)


def edit(path: Path) -> None:
    path.write_text(path.read_text() + "\nREWARD = 2\n")


@pytest.mark.slow
@pytest.mark.parametrize("name", [TOY.name, "mine_reward.py"])
def test_other_code_of_the_experiment_is_refused(own, capsys, name):
    words = [str(own), "--over", "ppo.gamma=0.8..0.9", "--seeds", "1", "--jobs", "1"]
    Path("FAIL").touch()
    assert sweep.main([*words, "--random", "1"]) == FAILURE
    Path("FAIL").unlink()
    edit(own.with_name(name))  # no run has a checkpoint: the mistake is mended
    assert sweep.main([*words, "--random", "1"]) == SUCCESS
    before = sorted(Path("sweeps").rglob("*"))
    edit(own.with_name(name))
    capsys.readouterr()
    assert sweep.main([*words, "--random", "2"]) == USAGE
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line == (
        "purerl: The experiment's code has changed since the sweep sweeps/toy_experiment began: "
        f"{name.removesuffix('.py') if name != TOY.name else name}; put it back, use another "
        "--name, or go on all the same with --allow-changes."
    )
    assert sorted(Path("sweeps").rglob("*")) == before
    assert sweep.main([*words, "--random", "2", "--allow-changes"]) == SUCCESS
    assert len(rows()) == 2


@pytest.mark.slow
def test_a_sweep_of_an_older_version_goes_on(own):
    words = [str(own), *RATES, "--seeds", "1", "--jobs", "1"]
    assert sweep.main(words) == SUCCESS
    file = Path("sweeps/toy_experiment/sweep.json")
    known = json.loads(file.read_text())
    assert next(iter(known["source"])) == TOY.name and "mine_reward" in known["source"]
    assert not [name for name in known["source"] if name.partition(".")[0] == "purerl"]
    old = ("experiment", "settings", "swept", "points", "seeds")
    file.write_text(json.dumps({name: known[name] for name in old}))
    edit(own)
    assert sweep.main([*words, "--log-every", "7"]) == SUCCESS


@pytest.mark.slow
def test_more_can_be_drawn_later(place):
    words = ["--over", "ppo.learning-rate=log:1e-4:1e-1", "--seeds", "1"]
    assert start("--random", "2", *words) == SUCCESS
    first = {row["point"]: row for row in rows()}
    assert start("--random", "4", *words) == SUCCESS
    later = {row["point"]: row for row in rows()}
    assert len(later) == 4 and {name: later[name] for name in first} == first


@pytest.mark.slow
def test_a_metric_that_no_run_has_is_told_after_the_first_one(place, capsys):
    assert start(*RATES, "--metric", "eval/episode_retrun", "--jobs", "1") == USAGE
    said = capsys.readouterr().err
    assert "no metric 'eval/episode_retrun'" in said and "'eval/episode_return'" in said
    assert len(list(Path("sweeps/toy_experiment/logs").iterdir())) == 1
    assert start(*RATES) == SUCCESS
    capsys.readouterr()
    assert start(*RATES, "--metric", "eval/episode_retrun") == USAGE  # all are done
    assert "no metric 'eval/episode_retrun'" in capsys.readouterr().err


@pytest.mark.slow
def test_a_point_without_the_metric_has_no_score_and_stops_no_other(place):
    words = ["--grid", "ppo.gamma=0.9,0.4,0.8", "--seeds", "1", "--jobs", "1"]
    for _ in range(2):
        assert start(*words) == SUCCESS
        found = {row["ppo.gamma"]: row for row in rows()}
        assert len(found) == 3 and {row["status"] for row in rows()} == {"done"}
        assert list(found)[-1] == "0.4" and found["0.4"]["score"] == ""


@pytest.mark.slow
def test_a_first_point_without_the_metric_is_told_once(place, capsys):
    words = ["--grid", "ppo.gamma=0.4,0.9", "--seeds", "1", "--jobs", "1"]
    assert start(*words) == USAGE
    assert "no metric 'eval/episode_return'" in capsys.readouterr().err
    assert start(*words) == SUCCESS and rows()[0]["ppo.gamma"] == "0.9"


@pytest.mark.slow
def test_a_name_is_no_reason(place, capsys):
    Path("sweeps/process1").mkdir(parents=True)
    Path("sweeps/process1/x").touch()
    assert start(*RATES, "--name", "process1") == USAGE
    said = capsys.readouterr().err
    assert said == (
        "purerl: sweeps/process1 holds no sweep, but other files; use another --name.\n"
    )


@pytest.mark.slow
def test_two_processes_do_not_carry_out_one_sweep(place, capsys):
    assert start(*RATES) == SUCCESS
    lock = scheduler.lock.FolderLock(Path("sweeps/toy_experiment"))
    assert start(*RATES) == USAGE
    lock.close()
    assert "is being carried out by another process" in capsys.readouterr().err


# --- Optuna and submitit ---


def has(package: str):
    missing = importlib.util.find_spec(package) is None
    return pytest.mark.skipif(missing, reason=f"{package} is not installed")


@pytest.mark.slow
@has("optuna")
def test_optuna_goes_on_where_it_was(place):
    words = ["--over", "ppo.learning-rate=log:1e-4:1e-1", "ppo.gamma=0.8,0.9", "--seeds", "2"]
    words += ["--jobs", "1"]
    assert start("--optuna", "3", *words, "--name", "whole") == SUCCESS
    assert start("--optuna", "2", *words, "--name", "parts") == SUCCESS
    from purerl.tune.sweep import study

    one = study.open_study(Path("sweeps/parts"))
    trials = one.get_trials()
    assert [trial.value for trial in trials] == pytest.approx(
        [1.5 - (trial.params["ppo.learning-rate"] - 3e-3) ** 2 for trial in trials]
    )
    # A kill between choosing a point and its score.
    from optuna.distributions import CategoricalDistribution, FloatDistribution

    rate = FloatDistribution(1e-4, 1e-1, log=True)
    one.sampler = study._sampler(2)
    spaces = {"ppo.learning-rate": rate, "ppo.gamma": CategoricalDistribution(("0.8", "0.9"))}
    one.ask(spaces)
    assert start("--optuna", "3", *words, "--name", "parts") == SUCCESS
    assert rows("parts") == rows("whole") and len(rows("whole")) == 3


@pytest.mark.slow
@has("optuna")
def test_optuna_tries_what_failed_once_more(place):
    words = ["--over", "ppo.learning-rate=log:1e-4:1e-1", "--optuna", "2", "--seeds", "1"]
    Path("FAIL").touch()
    assert start(*words, "--jobs", "1") == FAILURE
    assert [row["status"] for row in rows()] == ["failed", "failed"]
    failed = {row["point"]: row["ppo.learning-rate"] for row in rows()}
    Path("FAIL").unlink()
    assert start(*words, "--jobs", "1") == SUCCESS
    assert [row["status"] for row in rows()] == ["done", "done"]
    assert {row["point"]: row["ppo.learning-rate"] for row in rows()} == failed
    from purerl.tune.sweep import study

    trials = study.open_study(Path("sweeps/toy_experiment")).get_trials()
    assert None not in [trial.value for trial in trials]


@pytest.mark.slow
@has("optuna")
def test_optuna_chooses_no_more_for_what_failed(place):
    words = ["--over", "ppo.gamma=0.5,0.6", "--optuna", "2", "--seeds", "1"]
    assert start(*words) == FAILURE
    assert [row["status"] for row in rows()] == ["failed", "failed"]
    assert start(*words) == FAILURE  # no third one
    assert len(rows()) == 2


@pytest.mark.slow
@has("submitit")
def test_submitit_carries_points_out(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def call(slurm: str) -> subprocess.CompletedProcess:
        words = ["--grid", "ppo.learning-rate=1e-3,1e-2", "--seeds", "2", "--slurm", slurm]
        command = [sys.executable, "-m", "purerl.sweep", str(TOY), *words]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        return subprocess.run(command, env=environment, capture_output=True, text=True)

    said = call("cluster=local,timeout_min=5").stdout
    assert "2 of 2 points submitted" in said
    end = time.monotonic() + 240
    while len(list(Path("sweeps").rglob("*_result.pkl"))) < 2:
        assert time.monotonic() < end
        time.sleep(0.1)
    assert "0 of 2 points submitted" in call("cluster=local,timeout_min=5").stdout
    assert [row["status"] for row in rows()] == ["done", "done"]
    wrong = call("cluster=local,timeot_min=5")
    assert wrong.returncode == USAGE and "timeot_min" in wrong.stderr
    (line,) = call("timeout_min=5").stderr.splitlines()
    assert "There is no SLURM on this machine" in line


@has("submitit")
def test_the_table_tells_what_slurm_has_and_the_exit_code_what_failed(place, monkeypatch):
    """Of three points, all in the queue: one has failed, one has begun and holds no lock yet."""
    words = ["--grid", "ppo.gamma=0.5,0.7,0.9", "--seeds", "1", "--slurm", "timeout_min=1"]
    monkeypatch.setattr(slurm, "check", lambda *of: None)
    monkeypatch.setattr(slurm, "submit", lambda *of: (["p0000"], ["p0001", "p0002"]))
    assert start(*words) == SUCCESS
    assert {row["status"] for row in rows()} == {"waiting"}
    logs = Path("sweeps/toy_experiment/logs")
    logs.mkdir()
    (logs / "p0000.log").write_text("$ python\npurerl: gamma is 0.5.\n[exit code 2]\n")
    (logs / "p0001.log").write_text("$ python\n")
    assert start(*words) == FAILURE
    found = {row["point"]: row["status"] for row in rows()}
    assert found == {"p0000": "failed", "p0001": "waiting", "p0002": "waiting"}


def test_here_a_task_is_in_the_queue_as_long_as_its_process_lives(tmp_path):
    ended = subprocess.Popen("true")
    ended.wait()
    job = scheduler.Job("a", (), (), tmp_path / "log")
    for pid, lives in ((os.getpid(), True), (ended.pid, False)):
        assert slurm._is_under_way(job, tmp_path, "local", {"a": str(pid)}) is lives


@pytest.mark.slow
@has("submitit")
def test_a_task_whose_time_is_over_saves_and_goes_on(place):
    from tests.tune.sweep.test_scheduler import job

    one = job("a", "--ppo.gamma", "0.7")
    task = slurm.Task(one)

    def over(*_):
        raise TimeoutError(task.checkpoint().function.job)

    old = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, 1.5)
    with pytest.raises(TimeoutError):
        task()
    signal.signal(signal.SIGALRM, old)
    assert one.log.read_text().endswith("it is saved.\n[exit code 3]\n")
    assert slurm.Task(one)() == "done"


# --- real runs ---


@pytest.mark.slow
def test_a_sweep_that_was_killed_ends_as_one_left_in_peace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # where the toy finds its probes
    words = [str(TOY), "--grid", "ppo.learning-rate=1e-2,1e-3", "--seeds", "2"]
    words += ["--ppo.num-steps", "4800", "--checkpoints", "15"]
    assert sweep.main([*words, "--name", "peace", "--jobs", "2"]) == SUCCESS
    command = [sys.executable, "-m", "purerl.sweep", *words, "--name", "killed", "--jobs", "1"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    killed = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
    first = Path("sweeps/killed/toy_experiment/p0000-seed1")
    while len(list((first / "checkpoints").glob("0*"))) < 2:
        assert killed.poll() is None
        time.sleep(0.01)
    killed.kill()
    killed.wait()
    os.kill(int((first / ".lock").read_text()), signal.SIGKILL)
    assert len((first / "metrics.jsonl").read_text().splitlines()) < 150
    assert sweep.main([*words, "--name", "killed", "--jobs", "2"]) == SUCCESS
    assert "Resuming after update" in Path("sweeps/killed/logs/p0000.log").read_text()
    for point in ("p0000", "p0001"):
        lines = [read_lines(Path("sweeps") / name, point) for name in ("peace", "killed")]
        assert lines[0] == lines[1] and list(map(len, lines[0])) == [150, 150]
    assert rows("killed") == rows("peace")


@has("optuna")
def test_a_study_is_in_its_own_folder_whatever_its_name(place):
    from purerl.tune.sweep import study

    for name in ("a?1", "a?2", "b%20#c [1]"):
        folder = place / name
        folder.mkdir()
        study.open_study(folder).ask()
        assert (folder / study.FILE).is_file() and len(study.open_study(folder).trials) == 1
