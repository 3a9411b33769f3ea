"""One run on any number of devices, in one process or several: the same bits."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl.core.errors import FAILURE, INTERRUPTED, SUCCESS, USAGE
from purerl.devices import copies, programs, shards
from purerl.exact import xla_flags
from purerl.experiment import objects
from purerl.ppo.config import Evaluation
from purerl.runs import checkpoint_folder
from tests.runs import toy_experiment
from tests.training.test_run import ROOT, TOY

SMALL = ["--ppo.num-envs", "16", "--ppo.rollout-length", "8", "--ppo.num-steps", "512"]
SMALL += ["--ppo.num-minibatches", "2", "--ppo.episode-length", "12"]
SMALL += ["--evaluation.num-episodes", "2"]
SHARDED = [str(TOY), "--ppo.num-envs", "16", "--num-shards", "4", "--checkpoints", "3"]
# LLVM does less, in three quarters of the time. What a number of devices changes is done before, by
# XLA's passes, which remain (XLA's older loops, of `quick.OPTIONS`, are not equal).
QUICKLY = "--xla_backend_optimization_level=0"


def spawn(runs: Path, devices: int, *words: str, flags: str = "") -> subprocess.Popen:
    """Starts a run in a process that has so many virtual devices."""
    flags += f" --xla_force_host_platform_device_count={devices}"
    flags += " --xla_cpu_multi_thread_eigen=false"
    return subprocess.Popen(
        [sys.executable, "-m", "purerl.run", *words, "--runs", str(runs)],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        # The size of XLA's pool changes bits on a CPU, and it is no smaller than the devices.
        env=os.environ | {"NPROC": "8", "XLA_FLAGS": flags},
    )  # fmt: skip


def start(runs: Path, devices: int, *words: str, expect: int = SUCCESS, flags: str = "") -> str:
    process = spawn(runs, devices, *words, flags=flags)
    said = process.communicate(timeout=200)[0]
    assert process.returncode == expect, said
    return said


def start_two(runs: Path, *words: str, flags: str = "") -> list[subprocess.Popen]:
    """Starts a run of two processes with a device each."""
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        port = probe.getsockname()[1]
    places = [f"localhost:{port},2,{i}" for i in range(2)]
    return [spawn(runs, 1, *words, "--distributed", place, flags=flags) for place in places]


def both_end(processes: list[subprocess.Popen], code: int) -> list[str]:
    said = [process.communicate(timeout=200)[0] for process in processes]
    assert [process.returncode for process in processes] == [code, code], said
    return said


def digest(said: str) -> str:
    return re.findall(r"Done: .* Digest (\w+)", said)[0]


def lines(folder: Path) -> list[dict]:
    """Returns metrics.jsonl without the clock."""
    text = (folder / "metrics.jsonl").read_text()
    return [json.loads(line) | {"wall_s": 0} for line in text.splitlines()]


@pytest.fixture(scope="module")
def toy(tmp_path_factory) -> Path:
    """The folder of a run of 4 shards on one device."""
    runs = tmp_path_factory.mktemp("toy")
    start(runs, 1, *SHARDED, flags=QUICKLY)
    return runs / "toy_experiment" / "seed1"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("engine", "experiment", "told"),
    [("c", "experiments/cartpole_swingup.py --evaluation.number 1", "eval/episode_return"),
     ("jax", "tests/golden/seeing.py --evaluation.number 0", "train/episode_return")],
)  # fmt: skip
def test_physics_is_the_same_on_any_number_of_devices(tmp_path, engine, experiment, told):
    """20 s; 120 s with eyes and a memory, too, but for their evaluation."""
    words = [*experiment.split(), *SMALL, "--engine", engine, "--num-shards", "4"]
    start(tmp_path, 1, *words, "--name", "one", flags=QUICKLY)
    if engine == "jax":  # which puts its model on a device: in two processes, each on its own
        both_end(start_two(tmp_path, *words, "--name", "two", flags=QUICKLY), SUCCESS)
    else:
        start(tmp_path, 2, *words, "--name", "two", flags=QUICKLY)
    one, two = (lines(folder) for folder in sorted(tmp_path.glob("*/*")))
    assert one == two
    assert one[-1]["train/reward"] > 0 and one[-1][told] > 0


@pytest.mark.slow
def test_a_run_is_the_same_on_as_many_devices_as_shards_and_goes_on_with_fewer(toy, tmp_path):
    """Without --num-shards: the run says how many it was begun with."""
    start(tmp_path, 4, *SHARDED, flags=QUICKLY)
    folder = tmp_path / "toy_experiment" / "seed1"
    assert lines(folder) == lines(toy)
    last = checkpoint_folder.updates(folder / "checkpoints")[-1]
    checkpoint_folder.discard(folder / "checkpoints" / f"{last:012d}")
    words = [str(TOY), "--ppo.num-envs", "16", "--checkpoints", "3"]
    said = start(tmp_path, 2, *words, "--resume", flags=QUICKLY)
    assert "Resuming after update 4" in said and "2 on a device" in said
    assert lines(folder) == lines(toy)


# Sums over 128 samples a shard, which XLA computed otherwise where a device had one shard.
LARGER = ["--ppo.num-envs", "64", "--ppo.rollout-length", "8", "--ppo.num-steps", "2048"]
TRAINING = ["--evaluation.number", "0"]


@pytest.mark.slow
def test_by_default_every_device_has_a_shard(tmp_path):
    words = [str(TOY), *LARGER, *TRAINING]
    said = start(tmp_path, 2, *words, "--name", "default")
    explicit = start(tmp_path, 1, *words, "--num-shards", "2", "--name", "explicit")
    assert digest(said) == digest(explicit)
    folder = tmp_path / "toy_experiment"
    assert lines(folder / "default") == lines(folder / "explicit")
    facts = json.loads((folder / "default" / "manifest.json").read_text())
    assert facts["num_shards"] == facts["devices"] == 2
    assert "device_count" not in facts["flags"]["XLA_FLAGS"]


@pytest.mark.slow
def test_the_check_of_a_persons_own_devices():
    """Its short form, on two virtual ones."""
    words = ["2", "--", str(TOY), *TRAINING]
    said = subprocess.run(
        [sys.executable, "-m", "tests.long.shards", *words],
        cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True, timeout=200,
        env=os.environ | {"XLA_FLAGS": f"{os.environ['XLA_FLAGS']} {QUICKLY}"},
    ).stdout  # fmt: skip
    (one, *_, first), (two, *_, second) = (line.split() for line in said.splitlines()[1:])
    assert (one, two) == ("1", "2") and first == second and len(first) == 16


@pytest.mark.parametrize("by_kernel", [False, True])
def test_what_is_set_apart_stays_as_it_is(by_kernel, monkeypatch):
    monkeypatch.setattr(copies, "can_run", lambda: by_kernel)
    tree = {
        "float": jnp.array([[0.0, -0.0], [jnp.inf, -1e-42]]),
        "half": jnp.array(1.5, jnp.bfloat16),
        "int": jnp.array([-(2**31), 0, 7]),
        "unsigned": jnp.array([0, 2**32 - 1], jnp.uint32),
        "truth": jnp.array([True, False]),
        "nothing": jnp.zeros((0, 3)),
        "long": jnp.arange(1000).reshape(4, 250),
    }
    for apart in (shards.set_apart, jax.jit(shards.set_apart)):
        for before, after in zip(jax.tree.leaves(tree), jax.tree.leaves(apart(tree)), strict=True):
            assert (after.shape, after.dtype) == (before.shape, before.dtype)
            assert np.asarray(after).tobytes() == np.asarray(before).tobytes()


def test_a_shard_and_what_shards_send_are_copied_by_a_kernel(monkeypatch):
    """On a CPU bits are the same without, nearly always."""
    monkeypatch.setattr(copies, "can_run", lambda: True)
    parts = shards.parts_of(shards.Shards(2))
    weight = jnp.ones(3)
    run = jax.make_jaxpr(lambda x: parts.sum(lambda y: (weight * y).sum(0), x))
    closed = run(jnp.ones((2, 5, 3)))

    def passes(jaxpr):  # in order, and how many arrays each
        return [len(e.outvars) for e in jaxpr.eqns if e.primitive.name == "pallas_call"]

    (loop,) = [e for e in closed.jaxpr.eqns if e.primitive.name == "scan"]
    assert passes(loop.params["jaxpr"].jaxpr) == [2, 1]  # the weight and the shard; the sum
    assert passes(closed.jaxpr) == [1]  # all sums
    monkeypatch.setattr(copies, "AT_ONCE", 3)
    assert passes(jax.make_jaxpr(shards.set_apart)([weight] * 7).jaxpr) == [3, 3, 1]


def test_passes_that_are_off_are_the_users_too(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_a=b --xla_disable_hlo_passes=dce,fusion")
    assert xla_flags.equal_passes()[xla_flags.PASSES] == f"{xla_flags.UNEQUAL_PASSES},dce,fusion"
    monkeypatch.delenv("XLA_FLAGS")
    assert xla_flags.equal_passes()[xla_flags.PASSES] == xla_flags.UNEQUAL_PASSES


def test_what_learns_from_several_shards_is_compiled_without_them(monkeypatch):
    monkeypatch.setattr(xla_flags, "equal_passes", lambda: {"xla_no_such_option": "1"})
    config, env, network, _ = objects.build(toy_experiment.experiment)
    with pytest.raises(Exception, match="xla_no_such_option"):
        programs.compile_programs(
            config, env, network, Evaluation(number=0), True, shards.Shards(2)
        )


# --- several processes ---


@pytest.mark.slow
def test_two_processes_are_as_one(toy, tmp_path):
    first, second = both_end(start_two(tmp_path, *SHARDED, flags=QUICKLY), SUCCESS)
    assert lines(tmp_path / "toy_experiment" / "seed1") == lines(toy)
    assert "Digest" in first and "update" not in second  # one speaks for both


@pytest.mark.slow
def test_a_signal_to_one_stops_all_and_the_run_goes_on_in_one(tmp_path):
    long = [*SHARDED, "--ppo.num-steps", "19200", "--evaluation.number", "0"]
    start(tmp_path, 1, *long, "--name", "undisturbed", flags=QUICKLY)
    processes = start_two(tmp_path, *long, flags=QUICKLY)
    folder = tmp_path / "toy_experiment" / "seed1"
    while not (folder / "metrics.jsonl").exists() or len(lines(folder)) < 5:
        assert all(process.poll() is None for process in processes)
        time.sleep(0.02)
    processes[1].send_signal(signal.SIGTERM)
    first, second = both_end(processes, INTERRUPTED)
    stopped = [re.findall(r"Stopped after update (\d+) of 300", said) for said in (first, second)]
    assert stopped[0] == stopped[1] and 5 <= int(stopped[0][0]) < 300
    said = start(tmp_path, 1, *long, "--resume", flags=QUICKLY)
    assert f"Resuming after update {stopped[0][0]}" in said
    assert lines(folder) == lines(folder.with_name("undisturbed"))


@pytest.mark.slow
def test_a_process_that_loses_the_other_says_so(tmp_path):
    endless = [*SHARDED, "--ppo.num-steps", "6400000", "--evaluation.number", "0"]
    processes = start_two(tmp_path, *endless, flags=QUICKLY)
    metrics = tmp_path / "toy_experiment" / "seed1" / "metrics.jsonl"
    while not metrics.exists():
        assert all(process.poll() is None for process in processes)
        time.sleep(0.02)
    processes[1].kill()
    said = processes[0].communicate(timeout=100)[0]
    assert processes[0].returncode == FAILURE and "Traceback" not in said
    assert "another is gone" in said.splitlines()[-1] and "--resume" in said


@pytest.mark.slow
def test_mistakes_end_all_processes(toy, tmp_path):
    said = both_end(start_two(toy.parent.parent, *SHARDED), USAGE)
    assert all("seed1 exists; use --resume to go on" in one for one in said)
    said = both_end(start_two(tmp_path, str(TOY), "--num-shards", "1"), USAGE)
    assert all("there are 2 processes with 2 devices" in one for one in said)
    one = start(tmp_path, 1, str(TOY), "--distributed", "localhost:80", expect=USAGE)
    assert "it must be auto or HOST:PORT,NUM_PROCESSES,PROCESS_ID" in one


# --- sizes ---


def test_sizes_that_do_not_divide(tmp_path):
    rules = [
        ([], "num_shards = 3 does not divide num_envs = 8"),
        (["--num-shards", "4"], "devices = 3 does not divide num_shards = 4; devices could be 1, "
         "2, 4, or num_shards could be 3 or 6. With num_shards = 1 a single device is used."),
        (["--num-shards", "6", "--ppo.num-envs", "12", "--ppo.num-minibatches", "3"],
         "num_minibatches = 3 does not divide num_envs / num_shards * rollout_length = 8"),
        (["--num-shards", "3", "--num-seeds", "2"], "num_shards is 3, and 2 vmapped seeds"),
    ]  # fmt: skip
    code = "import ast, sys; from purerl import run; "
    code += "print(*map(run.main, ast.literal_eval(sys.argv[1])))"
    commands = [[str(TOY), *words, "--runs", str(tmp_path)] for words, _ in rules]
    flags = "--xla_force_host_platform_device_count=3"
    done = subprocess.run(
        [sys.executable, "-c", code, str(commands)],
        cwd=ROOT, capture_output=True, text=True, env=os.environ | {"XLA_FLAGS": flags},
    )  # fmt: skip
    assert done.stdout.split() == [str(USAGE)] * len(rules), done.stdout + done.stderr
    said = done.stderr.splitlines()
    assert len(said) == len(rules)
    for line, (_, rule) in zip(said, rules, strict=True):
        assert rule in line
    assert not (tmp_path / "toy_experiment").exists()
