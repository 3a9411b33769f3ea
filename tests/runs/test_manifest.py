"""What a run depends on is written down, and told apart from what it does not depend on."""

import dataclasses
import functools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from purerl.devices import compilation
from purerl.exact import xla_flags
from purerl.exact.rewrite import list_scatter_sums
from purerl.ppo import algorithm
from purerl.runs import manifest
from purerl.runs.build_experiment import build
from purerl.runs.experiment import Evaluation, load
from tests.runs.test_run import ROOT, TOY


def test_differences_are_named_by_path():
    old = {"versions": {"jax": "1", "flax": "2"}, "engine": "c", "git_revision": "a"}
    new = {"versions": {"jax": "1.1", "flax": "2"}, "flags": {}, "git_revision": "b"}
    assert manifest.differences(old, new) == [
        "engine: c -> (absent)",
        "flags: (absent) -> {}",
        "versions.jax: 1 -> 1.1",
    ]


def test_the_fingerprint_follows_what_can_change_bits_only():
    facts = manifest.collect("c", [])
    same = manifest.fingerprint(facts | {"git_revision": "other", "run_id": "x"})
    assert manifest.fingerprint(facts) == same
    assert manifest.fingerprint(facts | {"engine": "jax"}) != same


def test_a_pinned_thread_pool_counts_as_pinned(monkeypatch):
    monkeypatch.setenv("NPROC", "13")
    assert manifest.cpu_threads() == 13


def test_the_source_is_what_the_run_imports_and_nothing_else():
    found = manifest.imported_files(["purerl.ppo.algorithm", "tests.runs.toy_experiment"])
    assert {
        "purerl.ppo.advantages",
        "purerl.ppo.losses",
        "tests.ppo.probes",
        "purerl.ppo.networks",
    } <= set(found)
    assert not {"purerl.runs.console", "tests.runs.test_run", "jax"} & set(found)


def test_an_edit_changes_the_source_hashes(tmp_path, monkeypatch):
    package = tmp_path / "bodies_and_tasks"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "task.py").write_text(
        "import simulator, my_rewards\nfrom bodies_and_tasks import body\n\ndef build(): ...\n"
    )
    (package / "body.py").write_text("LEGS = 4\n")
    (package / "other.py").write_text("LEGS = 4\n")
    (tmp_path / "my_rewards.py").write_text("UPRIGHT = 1\n")  # of no package, and not installed
    installed = tmp_path / "anywhere"
    (installed / "simulator-1.0.dist-info").mkdir(parents=True)
    (installed / "simulator.py").write_text("import my_rewards\n")
    monkeypatch.syspath_prepend(str(installed))
    monkeypatch.syspath_prepend(str(tmp_path))
    import bodies_and_tasks.task as task

    before = manifest.source_hashes([task.build])
    assert manifest.source_hashes([functools.partial(task.build)]) == before
    (package / "other.py").write_text("LEGS = 8\n")
    assert manifest.source_hashes([task.build]) == before
    (tmp_path / "my_rewards.py").write_text("UPRIGHT = 2\n")
    assert (after := manifest.source_hashes([task.build])) != before
    (installed / "simulator.py").write_text("")
    assert manifest.source_hashes([task.build]) == after
    (package / "body.py").write_text("LEGS = 6\n")
    assert manifest.source_hashes([task.build]) not in (before, after)


def test_a_manifest_says_whether_the_run_is_exact_and_what_prevents_it(monkeypatch):
    assert manifest.collect("c", [])["bit_exact"] is True
    warp = manifest.collect("warp", [])
    assert warp["bit_exact"] is False and "warp" in warp["inexact_because"][0]


GRAPHS = "--xla_gpu_command_buffer_scheduling_mode=CONCURRENT --xla_gpu_graph_min_graph_size=1"
RULES = "--xla_gpu_experimental_enable_fusion_block_level_rewriter=true"
UNTIMED = f"--xla_gpu_autotune_level=0 --xla_gpu_enable_triton_gemm=false {RULES}"
FIXED = f"{GRAPHS} {UNTIMED}"
OWN_GRAPHS = "--xla_gpu_command_buffer_scheduling_mode=LHS --xla_gpu_graph_min_graph_size=5"


@pytest.mark.parametrize(
    "users, after, chosen",
    [
        (None, FIXED, "fixed"),
        ("--xla_a=b", f"--xla_a=b {FIXED}", "fixed"),
        (
            "--xla_gpu_enable_triton_gemm=true",
            f"--xla_gpu_enable_triton_gemm=true {GRAPHS} --xla_gpu_autotune_level=0 {RULES}",
            "fixed",
        ),
        ("--xla_gpu_autotune_level=4", f"--xla_gpu_autotune_level=4 {GRAPHS}", "by timing"),
        (
            "--xla_gpu_deterministic_ops=true",
            f"--xla_gpu_deterministic_ops=true {GRAPHS}",
            "fixed",
        ),
        (OWN_GRAPHS, f"{OWN_GRAPHS} {UNTIMED}", "fixed"),
    ],
)
def test_kernels_are_fixed_unless_the_user_wants_them_timed(monkeypatch, users, after, chosen):
    monkeypatch.setenv("XLA_FLAGS", users or "")
    monkeypatch.delenv(xla_flags.KEPT_TIMINGS, raising=False)
    xla_flags.set_flags()
    assert (xla_flags.KEPT_TIMINGS in os.environ) == (RULES in after)
    assert os.environ["XLA_FLAGS"] == after
    assert xla_flags.how_chosen("gpu") == chosen and xla_flags.how_chosen("cpu") == "fixed"
    reasons = manifest.collect("jax", [], xla_flags.how_chosen("gpu"))["inexact_because"]
    assert ["by timing" in reason for reason in reasons] == [True] * (chosen == "by timing")


@pytest.mark.parametrize("name", ["cartpole_swingup", "ant_run"])
def test_no_update_has_a_sum_without_a_fixed_order(name):
    source = load(ROOT / "experiments" / f"{name}.py").experiment
    config, env, network, _ = build(dataclasses.replace(source, engine="jax"))
    update = functools.partial(algorithm.update, config, env, network)
    trace = jax.make_jaxpr(update)(compilation.abstract_state(config, env, network))
    assert list_scatter_sums(trace) == []


def test_a_sum_without_a_fixed_order_is_found(monkeypatch):
    config, env, network, _ = build(load(TOY).experiment)

    def apply(params, observation, carry):
        output, carry = network.apply(params, observation, carry)
        value = output.value.reshape(-1)
        place = (value > 0).astype(jnp.int32)
        total = jnp.zeros(2).at[place].add(value)
        return output._replace(value=output.value + 0.0 * total.sum()), carry

    programs = compilation.compile_programs(
        config, env, network._replace(apply=apply), Evaluation(number=0), fresh=False
    )
    assert programs.unordered
    assert all("tests/runs/test_manifest.py" in place for place in programs.unordered)
    reasons = manifest.inexact_because("jax", "fixed", programs.unordered)
    assert reasons[0].startswith("a sum without a fixed order: scatter")


def test_a_run_on_c_imports_no_other_engine():
    """MJX takes most of a second to import, Warp two; a run on engine `c` needs neither."""
    lines = [
        "import sys",
        "from purerl import building, experiment, manifest",
        "chosen = experiment.find('ant_run')",
        "setup = building.build(chosen)",
        "manifest.collect(setup.engine, [chosen.build_env, chosen.build_network])",
        "assert setup.engine == 'c'",
        "print([name for name in sys.modules if name in ('mujoco.mjx', 'warp')])",
    ]
    words = [sys.executable, "-c", "\n".join(lines)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
