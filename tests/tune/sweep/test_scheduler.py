"""The scheduler: stand-ins for runs, killed, stopped, failing, and found again by their folders."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from purerl import UserError
from purerl.machine.lock import FolderLock
from purerl.tune.sweep import scheduler
from purerl.tune.sweep.scheduler import Job, environment_of, find_gpus, jobs_at_once
from tests.training.test_run import ROOT


def job(name: str, *words: str, seeds: int = 2) -> Job:
    runs = Path("runs")
    words = ("toy.py", *words, "--runs", str(runs), "--name", name, "--num-seeds", str(seeds))
    folders = tuple(runs / "toy_experiment" / f"{name}-seed{n}" for n in range(1, seeds + 1))
    return Job(name, words, folders, Path("logs") / f"{name}.log")


def carry_out(jobs, at_once: int = 2, gpus=(), began=None) -> dict:
    ended = []
    scheduler.carry_out(jobs, at_once, list(gpus), began or (lambda job: None), ended.append)
    return {one.job.name: (one.status, one.said) for one in ended}


def begun(one: Job) -> int:
    """Returns how often a job was started."""
    return one.log.read_text().count("$ python ")


@pytest.mark.parametrize("last", ["[exit code -", "[exit code 1", "[exit code ]", "[exit co", "x"])
def test_a_torn_last_line_of_a_log_is_of_a_job_that_was_cut(place, last):
    one = job("a")
    one.log.parent.mkdir()
    one.log.write_text(f"$ python -m purerl.run\npurerl: wrong\n{last}")
    assert scheduler.how_it_ended(one).status == "stopped"
    one.log.write_text("$ python -m purerl.run\npurerl: wrong\n[exit code 1]\n")
    assert scheduler.how_it_ended(one) == (one, "failed", "wrong")


def test_a_log_that_the_disk_refuses_is_one_line(place, monkeypatch):
    one = job("a")
    one.log.parent.mkdir()
    one.log.symlink_to("/dev/full")
    with pytest.raises(UserError, match=r"logs/a.log cannot be written: Too many levels of symb"):
        scheduler.start(one, {})
    assert scheduler.end(one, 0).status == "stopped"
    assert scheduler.how_it_ended(one).said == ""  # a device has no end
    monkeypatch.setattr(scheduler.files, "open_log", lambda _: open("/dev/full", "ab", 0))  # noqa: SIM115
    with pytest.raises(UserError, match=r"logs/a.log cannot be written: No space left on device"):
        scheduler.start(one, {})
    assert scheduler.end(one, 0).status == "stopped"


@pytest.mark.slow
def test_a_job_that_fails_is_reported_and_the_others_go_on(place):
    jobs = [job("a", "--ppo.gamma", "0.5"), job("b"), job("c", "--ppo.gamma", "0.6"), job("d")]
    found = carry_out(jobs)
    assert found == {
        "a": ("failed", "gamma is 0.5. Take another one."),
        "b": ("done", ""),
        "c": ("failed", "killed by SIGKILL"),
        "d": ("done", ""),
    }
    assert scheduler.how_it_ended(jobs[0]).said == found["a"][1]  # by its folder alone
    assert set(carry_out(jobs)) == {"a", "b", "c", "d"}
    assert [begun(one) for one in jobs] == [2, 1, 2, 1]  # what is done is not started again


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_saves_all_runs_and_they_are_resumed(place, number):
    jobs = [job(name, "--ppo.gamma", "0.7") for name in "abc"]

    def stop():
        while not all(folder.exists() for one in jobs[:2] for folder in one.folders):
            time.sleep(0.01)
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=stop)
    thread.start()
    assert carry_out(jobs) == {"a": ("stopped", ""), "b": ("stopped", "")}
    thread.join()
    assert not jobs[2].log.exists()
    assert "[exit code 3]" in jobs[0].log.read_text()
    assert {status for status, _ in carry_out(jobs[:2]).values()} == {"done"}
    assert "resumed" in jobs[0].log.read_text().split("$ python ")[2]


@pytest.mark.slow
def test_a_run_that_outlived_its_scheduler_is_waited_for(place):
    one = job("a")
    holds = f"import sys; from purerl.machine.lock import FolderLock; from pathlib import Path\n\
locks = [FolderLock(Path(p)) for p in {list(map(str, one.folders))}]\nprint('held', flush=True)\n\
sys.stdin.read()"
    other = subprocess.Popen(
        [sys.executable, "-c", holds], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert other.stdout.readline() == b"held\n"
    timer = threading.Timer(1.0, other.stdin.close)
    timer.start()
    begin = time.monotonic()
    assert carry_out([one]) == {"a": ("done", "")}
    assert time.monotonic() - begin >= 0.9 and begun(one) == 1
    other.wait()


@pytest.mark.slow
def test_an_error_of_ours_leaves_no_run_behind(place):
    one = job("a", "--ppo.gamma", "0.7")

    def began(job):
        while not job.folders[1].exists():
            time.sleep(0.01)
        raise RuntimeError

    with pytest.raises(RuntimeError):
        carry_out([one], began=began)
    assert one.log.read_text().endswith("[exit code 3]\n")


@pytest.mark.slow
def test_gpus_are_taken_in_turn_by_those_that_run(place):
    jobs = [job(name) for name in "abcd"]
    carry_out(jobs, 2, ["4", "7"])
    said = [one.log.read_text().splitlines()[1] for one in jobs]
    assert sorted(said[:2]) == ["begun 4", "begun 7"] and set(said) == {"begun 4", "begun 7"}


@pytest.mark.slow
def test_a_terminal_s_ctrl_c_reaches_a_run_once(place):
    """A second signal would end it at once: the terminal's own must not reach it."""
    one = job("a")
    carry_out([one])
    assert "alone" in one.log.read_text().splitlines()


@pytest.mark.slow
def test_done_is_what_has_its_last_checkpoint(place):
    one = job("a")
    assert not scheduler.is_done(one)
    carry_out([one])
    assert scheduler.is_done(one)
    (one.folders[1] / "checkpoints" / f"{4:012d}").rmdir()
    assert not scheduler.is_done(one)
    carry_out([one])
    assert scheduler.is_done(one) and begun(one) == 2


def test_how_many_at_once(monkeypatch, tmp_path):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)))
    assert jobs_at_once([], {}) == 8
    assert jobs_at_once([], {"NPROC": "1"}) == 16
    assert jobs_at_once([], {"NPROC": "64"}) == 1
    assert jobs_at_once(["0", "1"], {}) == 2
    assert find_gpus({"CUDA_VISIBLE_DEVICES": "2, 5"}) == ["2", "5"]
    assert find_gpus({"CUDA_VISIBLE_DEVICES": ""}) == []
    assert find_gpus({"CUDA_VISIBLE_DEVICES": "0", "JAX_PLATFORMS": "cpu"}) == []
    (tmp_path / "nvidia-smi").write_text("#!/bin/sh\necho GPU 0: A\necho GPU 1: A\n")
    (tmp_path / "nvidia-smi").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    assert find_gpus({}) == ["0", "1"]


def test_runs_that_share_a_gpu_share_its_memory():
    two = ["0", "1"]
    assert environment_of(3, 4, two)["CUDA_VISIBLE_DEVICES"] == "1"
    assert environment_of(3, 4, two)["XLA_PYTHON_CLIENT_MEM_FRACTION"] == "0.45"
    assert environment_of(1, 2, two) == {"CUDA_VISIBLE_DEVICES": "1"}
    assert environment_of(0, 1, ["0"]) == environment_of(3, 4, []) == {}


def test_the_lock_that_a_look_takes_is_given_back(place):
    one = job("a")
    one.folders[0].mkdir(parents=True)
    assert not scheduler.is_locked(one)
    lock = FolderLock(one.folders[0])
    assert scheduler.is_locked(one)
    lock.close()
    assert not scheduler.is_locked(one)
