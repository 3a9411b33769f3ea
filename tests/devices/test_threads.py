"""XLA's threads: engine `jax` on two of them stops for ever, so it gets one."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from purerl.devices import threads
from tests import quick

ROOT = Path(__file__).parents[2]
SEVERAL = "--xla_a=b --xla_force_host_platform_device_count=2"


def test_a_pinned_thread_pool_counts_as_pinned(monkeypatch):
    monkeypatch.setenv("NPROC", "13")
    assert threads.cpu_threads() == 13


@pytest.mark.parametrize(
    ("engine", "cores", "environment", "begun", "then"),
    [
        ("jax", 2, {}, False, "1"),
        ("jax", 2, {"XLA_FLAGS": "--xla_a=b"}, False, "1"),
        ("jax", 1, {}, False, None),
        ("jax", 3, {}, False, None),
        ("c", 2, {}, False, None),
        ("auto", 2, {}, False, None),  # on a CPU, that is c
        ("jax", 2, {}, True, None),
        ("jax", 8, {"NPROC": "2"}, False, "2"),  # the user's own, who is told
        ("jax", 2, {"NPROC": "4"}, False, "4"),
        ("jax", 2, {"XLA_FLAGS": SEVERAL}, False, None),
        ("jax", 2, {"JAX_NUM_CPU_DEVICES": "2"}, False, None),
    ],
)
def test_one_thread_is_left_where_two_would_stop(
    monkeypatch, engine, cores, environment, begun, then
):
    for name in ("NPROC", "PJRT_NPROC", "XLA_FLAGS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "environ", os.environ | environment | {"JAX_PLATFORMS": "cpu"})
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setattr(threads, "jax_has_begun", lambda: begun)
    threads.leave_one(engine)
    assert os.environ.get("NPROC") == then
    assert threads.cpu_threads() == int(then or cores)


@pytest.mark.parametrize(("platforms", "then"), [("", None), ("cuda", None), ("cpu", "1")])
def test_a_machine_with_a_gpu_keeps_its_threads(monkeypatch, platforms, then):
    monkeypatch.delenv("PJRT_NPROC", raising=False)
    kept = {name: value for name, value in os.environ.items() if name not in ("NPROC", "XLA_FLAGS")}
    monkeypatch.setattr(os, "environ", kept | {"JAX_PLATFORMS": platforms})
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    monkeypatch.setattr(threads, "jax_has_begun", lambda: False)
    monkeypatch.setattr(Path, "exists", lambda path: path == Path("/dev/nvidiactl"))
    threads.leave_one("jax")
    assert os.environ.get("NPROC") == then


@pytest.mark.slow
def test_the_command_has_one_thread_before_jax_begins(tmp_path):
    """In a process of its own, with two cores."""
    script = (
        "import os, runpy, sys; os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2]);"
        "sys.argv[0] = 'run'; runpy.run_module('purerl.run', run_name='__main__')"
    )
    words = ["cartpole_swingup", "--engine", "jax", "--ppo.num-steps", "1024"]
    words += ["--ppo.num-envs", "16", "--ppo.rollout-length", "32", "--evaluation.number", "0"]
    env = {name: value for name, value in os.environ.items() if name != "NPROC"}
    # Compiled in half the time: what stops is a library's.
    env["XLA_FLAGS"] = quick.FLAGS
    done = subprocess.run(
        [sys.executable, "-c", script, *words, "--runs", str(tmp_path), "--name", "one"],
        cwd=ROOT, env=env | {"JAX_PLATFORMS": "cpu"}, timeout=300, capture_output=True, text=True,
    )  # fmt: skip
    assert not done.returncode, done.stderr
    assert "Done: 1,024 steps" in done.stdout and "stop for ever" not in done.stdout
    manifest = json.loads((tmp_path / "cartpole_swingup" / "one" / "manifest.json").read_text())
    assert manifest["device"]["threads"] == 1


FOUR_SEEDS = """
import functools
import jax, jax.numpy as jnp
from purerl import Config, networks
from purerl.devices.programs import in_turn
from purerl.envs import cartpole_swingup
from purerl.ppo import algorithm

env = cartpole_swingup.build(engine="c")
given = jax.eval_shape(env.reset, jax.random.key(0)).observation
network = networks.recurrent(networks.RecurrentOptions(), jnp.zeros(given.shape), 1)
network = network._replace(init=in_turn(network.init))
init = functools.partial(algorithm.init, Config(num_steps=8192), env, network)
for number in range(3):
    keys = jax.random.split(jax.random.key(number), 4)
    jax.block_until_ready(jax.jit(jax.vmap(init))(keys))
"""


@pytest.mark.slow
def test_vmapped_seeds_of_a_cell_begin_on_two_threads():
    """12 s. With the network's `init` as it is, the first never ended."""
    environment = os.environ | {"NPROC": "2", "JAX_PLATFORMS": "cpu"}
    subprocess.run(
        [sys.executable, "-c", FOUR_SEEDS], env=environment, cwd=ROOT, timeout=120, check=True
    )
