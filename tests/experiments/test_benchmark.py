"""The benchmark's figures: what is counted, what is read, what a command is made of."""

import collections
import csv
import dataclasses
import json
import os
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import purerl
from purerl.core.errors import UserError
from purerl.experiment.loading import find
from purerl.experiments.benchmarks import benchmark, scaling, start_up
from tests import quick


def experiment():
    """cartpole_swingup of 4 environments and 2 steps."""
    chosen = find("cartpole_swingup")
    config = dataclasses.replace(
        chosen.ppo, num_envs=4, rollout_length=2, num_minibatches=1, episode_length=5
    )
    return dataclasses.replace(chosen, ppo=config)


@pytest.fixture(scope="module")
def small():
    """Its physics and update, compiled."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax, "jit", quick.Jit)
        return benchmark.make_bench(experiment(), ("physics alone", "update"))


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_quickly")
def test_every_part_is_run():
    bench = benchmark.make_bench(experiment())
    names = [name for name in benchmark.PARTS if name != "eyes"]  # it has none
    assert [part.name for part in bench.parts] == names
    learned, _ = bench.parts[2].call()
    weights = [jax.tree.leaves(state.params)[0] for state in (bench.state, learned)]
    assert (np.asarray(weights[0]) != np.asarray(weights[1])).any()
    assert all(t.steps_per_second > 0 for t in benchmark.measure(bench.parts, 1, 0.0))


def test_eyes_look_once_in_each_step_where_bodies_are():
    """Each picture is another one: the last is of the last step."""
    seen = SimpleNamespace(see=lambda xpos, xmat, boxes: xpos + boxes[0])
    readings = SimpleNamespace(xpos=jnp.zeros((1, 3)), xmat=jnp.eye(3)[None])
    env = SimpleNamespace(
        eyes=seen,
        physics=SimpleNamespace(init=lambda qpos, qvel, changes: (None, readings)),
        scenery=lambda state: (state.physics.qpos[None], None),
    )
    places = collections.namedtuple("Places", "qpos qvel")(jnp.ones((2, 3)), jnp.zeros((2, 3)))
    state = SimpleNamespace(env_state=purerl.State(places, *6 * [()]))
    last = benchmark.eyes_alone(env, SimpleNamespace(rollout_length=4), state)
    np.testing.assert_allclose(last, 1 + 3e-4, rtol=1e-6)


@pytest.mark.slow
def test_only_the_parts_asked_for_are_compiled(small):
    assert [part.name for part in small.parts] == ["physics alone", "update"]
    assert [part.steps for part in small.parts] == [8, 8]


def test_bare_physics_moves_every_environment(small):
    before, after = small.state.env_state.physics, small.parts[0].call()
    assert (np.asarray(after.qpos) != np.asarray(before.qpos)).any(axis=1).all()
    np.testing.assert_allclose(after.time - before.time, 2 * 2 * 0.01, atol=1e-6)


def test_memory_counts_the_state_and_what_an_update_needs_beside_it(small):
    found = benchmark.memory(small)
    leaves = jax.tree.leaves(small.state)
    keys = [
        jax.random.key_data(x)
        for x in leaves
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)
    ]
    plain = [x for x in leaves if not jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)]
    assert found["state"] == sum(x.nbytes for x in keys + plain)
    assert found["update"] - found["state"] == small.parts[1].temporary > 0
    assert found["process, at most"] > 50e6  # JAX alone is more
    assert "| state | " in benchmark.memory_table(found, 4)


def test_rates_are_steps_over_median_seconds():
    calls = []
    part = benchmark.Part("one", lambda: calls.append(1), 100, 0.0, 0)
    (timing,) = benchmark.measure([part], rounds=3, least_s=0.01)
    assert len(calls) > 3
    assert timing.steps_per_second == pytest.approx(100 / timing.seconds)


def test_only_kernels_on_the_gpus_streams_count_as_busy():
    def line(name, *durations_ns):
        return SimpleNamespace(
            name=name, events=[SimpleNamespace(duration_ns=d) for d in durations_ns]
        )

    gpu = [line("Stream #1(Compute)", 10, 20), line("Stream #2(MemcpyD2H)", 5)]
    planes = [
        SimpleNamespace(name="/device:GPU:0", lines=[*gpu, line("XLA Modules", 1000)]),
        SimpleNamespace(name="/host:CPU", lines=[line("Stream of thought", 7)]),
    ]
    assert benchmark.kernel_seconds(planes) == pytest.approx(35e-9)


def test_a_rate_without_known_steps_counts_the_episodes():
    result = {"episode_length": np.array([3, 4])}
    part = benchmark.Part("evaluation", lambda: result, None, 0.0, 0)
    (timing,) = benchmark.measure([part], rounds=1, least_s=0.0)
    assert timing.steps_per_second == pytest.approx(7 / timing.seconds)


def test_shares_are_of_the_first_part():
    timings = [benchmark.Timing("a", 0, 1, 200.0), benchmark.Timing("b", 0, 1, 50.0, 0.5)]
    *_, first, second = benchmark.table(timings).splitlines()
    assert first.endswith("| 1.00 |  |") and second.endswith("| 0.25 | 0.50 |")


def test_compile_times_are_read_from_a_runs_output():
    output = "plan\nCompiled: collect 3.2 s, init 0.9 s, improve 11.0 s\nmore 1.0 s"
    assert start_up.compile_times(output) == {"collect": 3.2, "init": 0.9, "improve": 11.0}
    assert start_up.compile_times("nothing yet") == {}


@pytest.mark.slow
def test_a_start_is_watched_to_its_first_update(tmp_path):
    toy = "tests/runs/toy_experiment.py"
    cold = start_up.start(toy, "c", [], tmp_path, "cold")
    assert 0 < cold.planned <= cold.compiled <= cold.first_update
    assert 0.5 < cold.cpu < 10 * cold.first_update  # importing JAX takes most of a second
    assert set(cold.compile_times) == {"collect", "improve", "init"}  # evaluation: later
    assert (cold.engine, cold.cache) == ("c", "cold")


def test_a_run_that_ends_before_its_update_is_an_error(tmp_path):
    with pytest.raises(UserError, match="must be at least 1"):
        start_up.start(
            "tests/runs/toy_experiment.py", "c", ["--ppo.num-envs", "0"], tmp_path, "cold"
        )


def test_scaling_changes_one_axis_and_keeps_minibatches():
    config = dataclasses.replace(find("ant_run").ppo, num_envs=256, rollout_length=32)

    def sizes(axis, value):
        words = scaling.overrides(axis, value, config, 1024)
        return dict(zip(words[::2], words[1::2], strict=False))

    assert sizes("envs", 16384) == {
        "--ppo.num-envs": "16384",
        "--ppo.rollout-length": "8",
        "--ppo.num-minibatches": "128",
    }
    assert sizes("envs", 64)["--ppo.num-minibatches"] == "1"
    assert sizes("length", 128)["--ppo.num-minibatches"] == "32"
    assert scaling.overrides("length", 128, config, 4096)[5] == "8"
    wide = scaling.overrides("width", 512, config, 1024)
    assert wide[-3:] == ["--network.value-hidden", "512", "512"]


def test_mistakes_are_told_before_measuring(capsys):
    for words, said in [
        (["--minibatch", "0"], "--minibatch is 0; it must be at least 1."),
        (["--ppo.num-env", "3"], "Did you mean --ppo.num-envs?"),
    ]:
        with pytest.raises((SystemExit, UserError)) as raised:
            scaling.main(["--axes", "envs", *words])
        assert said in f"{raised.value}{capsys.readouterr().err}"


def test_a_point_reads_the_benchmark_it_started(monkeypatch):
    found = {
        "parts": [
            {"steps_per_second": 200.0, "compile_s": 1.0},
            {"steps_per_second": 150.0, "compile_s": 2.0},
        ],
        "memory": {"state": 2e6, "update": 5e6, "process, at most": 9e8},
    }

    def run(command, **_):
        assert command[0] == sys.executable and command[3:6] == ["ant_run", "--seed", "3"]
        with open(command[command.index("--json") + 1], "w") as file:
            json.dump(found, file)
        return SimpleNamespace(returncode=ended)

    ended = 0
    monkeypatch.setattr(scaling.subprocess, "run", run)
    sweep = scaling.Sweep("ant_run", ["--seed", "3"], find("ant_run").ppo, 1024)
    row = scaling.point(sweep, "envs", 64)
    assert (row["steps_per_s"], row["physics_steps_per_s"], row["share"]) == (150, 200, 0.75)
    assert (row["state_mb"], row["update_mb"], row["process_mb"]) == (2.0, 5.0, 900)
    before = os.sched_getaffinity(0)
    on = []
    monkeypatch.setattr(os, "sched_setaffinity", lambda _, cores: on.append(set(cores)))
    scaling.point(sweep, "cores", 1)
    assert on == [{min(before)}, before]  # the child's, then one's own again
    ended = 2
    with pytest.raises(UserError, match="envs 64 failed"):
        scaling.point(sweep, "envs", 64)


def test_measuring_one_axis_again_keeps_the_others(tmp_path):
    path = tmp_path / "scaling.csv"
    scaling.write(path, [{"axis": "envs", "value": 64}, {"axis": "seeds", "value": 1}])
    scaling.write(path, [{"axis": "seeds", "value": 2}])
    rows = [(row["axis"], row["value"]) for row in csv.DictReader(path.open())]
    assert rows == [("envs", "64"), ("seeds", "2")]


def test_a_file_that_cannot_be_written_is_told_before_measuring(tmp_path, capsys):
    for main, words in [(benchmark.main, ["ant_run", "--json"]), (scaling.main, ["--csv"])]:
        with pytest.raises(SystemExit):
            main([*words, str(tmp_path / "none" / "found.json")])
        assert "cannot be written" in capsys.readouterr().err
