"""`--resume auto`, and the script for SLURM that goes by it, with stand-ins for SLURM and W&B."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import purerl
from purerl import run
from purerl.core.errors import SUCCESS
from purerl.experiment.new_project import TEMPLATES
from tests.training.test_run import LONG, ROOT, TOY, digest, folder, start

SCRIPT = TEMPLATES / "train.sbatch"
STAND_INS = {
    "srun": 'while [ "${1#--}" != "$1" ]; do shift; done; exec "$@"',
    "scontrol": '[ "$1" = show ] && echo "   JobState=$STATE X=1" || echo "$@" >> calls',
}
WANDB = """import json
from pathlib import Path

Settings = dict


class init:
    def __init__(self, **options):
        self.file = Path("wandb-" + options["id"])
        known = self.file.read_text().splitlines() if self.file.exists() else ["-1"]
        self.step = int(known[-1]) + 1

    def define_metric(self, *names, **options): ...

    def finish(self): ...

    def log(self, row, step):
        with self.file.open("a") as file:
            file.write(json.dumps(row["update"]) + chr(10))
        self.step = step + 1
"""


@pytest.fixture
def job(tmp_path, monkeypatch):
    """Starts the script as SLURM would, in an empty folder, by a `python` of one's own."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wandb.py").write_text(WANDB)

    def submit(words=(), python=f'exec {sys.executable} "$@"', state="RUNNING"):
        for name, text in {**STAND_INS, "python": python}.items():
            (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
            (tmp_path / name).chmod(0o755)
        places = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "PYTHONPATH": f"{ROOT}:{tmp_path}"}
        slurm = {"SLURM_JOB_ID": "7", "SLURM_CPUS_PER_TASK": "2", "STATE": state}
        return subprocess.Popen(["bash", str(SCRIPT), *words], env=os.environ | places | slurm)

    return submit


def calls() -> list[str]:
    return Path("calls").read_text().splitlines() if Path("calls").exists() else []


@pytest.mark.parametrize(
    ("code", "state", "again"),
    [(0, "RUNNING", 0), (1, "RUNNING", 0), (3, "RUNNING", 1), (143, "RUNNING", 1)]
    + [(3, "COMPLETING", 0), (3, "CANCELLED", 0)],
)
def test_a_job_is_queued_again_if_it_was_asked_to_stop_and_not_cancelled(job, code, state, again):
    """Of the run's exit code; 143 is that of one which SIGTERM ended while it started."""
    assert job(["mine.py"], f'echo "$@" > words; exit {code}', state).wait() == code
    assert Path("words").read_text() == "-m purerl.run mine.py --resume auto\n"
    assert calls() == ["requeue 7"] * again


@pytest.mark.slow
def test_a_job_that_is_preempted_and_requeued_is_the_run_of_one_left_in_peace(job, tmp_path):
    """25 s: the run is the same to the last bit, and one run of W&B, with every line once."""
    words = [str(TOY), "--runs", "runs", *LONG, "--wandb", "online"]
    first = job(words)
    file = folder(Path("runs")) / "metrics.jsonl"
    while not file.exists() or not file.read_bytes():
        assert first.poll() is None
        time.sleep(0.01)
    os.kill(int((file.parent / ".lock").read_text()), signal.SIGTERM)
    first.send_signal(signal.SIGTERM)
    assert first.wait() == 3 and calls() == ["requeue 7"]
    assert job(words).wait() == 0 and calls() == ["requeue 7"]
    assert start(tmp_path / "peace", *LONG) == SUCCESS
    assert digest(Path("runs")) == digest(tmp_path / "peace")
    (of_wandb,) = Path().glob("wandb-*")
    sent = [int(line) for line in of_wandb.read_text().splitlines()]
    assert sent == [json.loads(line)["update"] for line in file.read_text().splitlines()]


@pytest.fixture(scope="module")
def begun(tmp_path_factory) -> purerl.Run:
    """A run that `auto` has begun, with settings that its file has not."""
    few = {"ppo.num_steps": 64, "env.steps": 3, "evaluation.number": 0}
    place = tmp_path_factory.mktemp("begun")
    return purerl.train(str(TOY), few, runs=place, seed=5, name="a", checkpoints=2, resume="auto")


@pytest.mark.parametrize("words", [["--resume"], ["--resume", "auto"], ["--resume", "--seed", "5"]])
def test_what_a_command_leaves_out_is_as_the_run_was_begun(begun, words, capsys):
    assert start(begun.folder.parents[1], "--name", "a", *words) == SUCCESS
    said = capsys.readouterr().out
    assert "settings     as the run was begun: env.steps: 4 -> 3, " in said
    assert "ppo.num_steps: 399 -> 64" in said and "Already done" in said


def test_what_it_gives_is_compared_with_the_run(begun, capsys):
    place = begun.folder.parents[1]
    assert start(place, "--name", "a", "--resume", "--env.steps", "4") == purerl.UserError.exit_code
    said = capsys.readouterr().err
    assert "exactly:\n  settings.env.steps: 3 -> 4\n" in said and "num_steps" not in said
    assert "\nLeave out what differs, train anew" in said


def test_where_the_file_was_edited_its_settings_count(begun, tmp_path, capsys):
    edited = tmp_path / TOY.name
    edited.write_text(TOY.read_text().replace("num_epochs=1", "num_epochs=2"))
    words = [str(edited), "--runs", str(begun.folder.parents[1]), "--name", "a", "--resume"]
    assert run.main(words) == purerl.UserError.exit_code
    said = capsys.readouterr().err
    assert "settings.ppo.num_epochs: 1 -> 2" in said and "settings.env.steps: 3 -> 4" in said
