"""What a run depends on is written down, and told apart from what it does not depend on."""

import dataclasses
import functools
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from hypothesis import given, strategies as st

from purerl import exact
from purerl.devices import programs
from purerl.devices.shards import Shards
from purerl.exact import xla_flags
from purerl.experiment.loading import load_file
from purerl.experiment.objects import build
from purerl.ppo import algorithm
from purerl.ppo.config import Evaluation
from purerl.runs import manifest, resume
from purerl.runs.manifest import fingerprint

ROOT = Path(__file__).parent.parent.parent
TOY = Path(__file__).parent / "toy_experiment.py"


def test_differences_are_named_by_path():
    old = {"versions": {"jax": "1", "flax": "2"}, "engine": "c", "git_revision": "a"}
    new = {"versions": {"jax": "1.1", "flax": "2"}, "flags": {}, "git_revision": "b"}
    assert manifest.differences(old, new) == [
        "engine: c -> (absent)",
        "flags: (absent) -> {}",
        "versions.jax: 1 -> 1.1",
    ]


NAMES = st.text(st.characters(codec="utf-8", exclude_characters="."), min_size=1)
LEAVES = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
JSON = st.recursive(LEAVES, lambda v: st.lists(v) | st.dictionaries(NAMES, v), max_leaves=12)
FACTS = st.dictionaries(NAMES.filter(lambda name: name not in manifest.INFORMATIVE), JSON)


@given(FACTS, st.sampled_from(sorted(manifest.INFORMATIVE)), JSON)
def test_a_manifest_read_back_from_its_file_is_the_same(facts, name, value):
    read = json.loads(json.dumps(facts)) | {name: value}
    assert manifest.differences(facts, read) == manifest.differences(read, facts) == []
    assert fingerprint({}, facts, b"") == fingerprint({}, read, b"")


def _counts(path):
    return path[0] not in manifest.INFORMATIVE


@given(FACTS, st.lists(NAMES, min_size=1, max_size=3).filter(_counts))
def test_one_changed_value_is_named_and_nothing_else(facts, path):
    def with_value(tree, path, value):
        inner = tree.get(path[0]) if isinstance(tree.get(path[0]), dict) else {}
        return tree | {path[0]: with_value(inner, path[1:], value) if path[1:] else value}

    old, new = (with_value(facts, path, value) for value in ("before", "after"))
    assert manifest.differences(old, new) == [f"{'.'.join(path)}: before -> after"]
    assert fingerprint({}, old, b"") != fingerprint({}, new, b"")


def test_the_fingerprint_follows_what_can_change_bits_only():
    facts = manifest.describe_process("c", [])
    mine = fingerprint({"seed": 1}, facts, b"source")
    assert fingerprint({"seed": 1}, facts | {"git_revision": "x", "run_id": "x"}, b"source") == mine
    others = [({"seed": 2}, facts, b"source"), ({"seed": 1}, facts | {"engine": "jax"}, b"source")]
    for other in [*others, ({"seed": 1}, facts, b"edited")]:
        assert fingerprint(*other) != mine


@pytest.mark.parametrize(
    ("option", "value", "found"),
    [
        ("jax_random_seed_offset", 5, ["jax.jax_random_seed_offset: 0 -> 5"]),
        ("jax_softmax_custom_jvp", True, ["jax.jax_softmax_custom_jvp: False -> True"]),
        (
            "jax_default_matmul_precision",
            "high",
            ["jax.jax_default_matmul_precision: None -> high"],
        ),
        ("jax_log_compiles", True, []),
        ("jax_compilation_cache_max_size", 7, []),
    ],
)
def test_an_option_of_jax_that_can_move_bits_is_written_down(option, value, found):
    before, kept = manifest.describe_process("c", []), jax.config.values[option]
    jax.config.update(option, value)
    try:
        now = manifest.describe_process("c", [])
    finally:
        jax.config.update(option, kept)
    assert manifest.differences(before, now) == found


def test_a_manifest_says_whether_the_run_is_exact_and_what_prevents_it():
    assert manifest.describe_process("c", [])["bit_exact"] is True
    warp = manifest.exactness("warp", "fixed")  # its package need not be installed
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
    exact.set_xla_flags()
    assert (xla_flags.KEPT_TIMINGS in os.environ) == (RULES in after)
    assert os.environ["XLA_FLAGS"] == after
    assert exact.how_chosen("gpu") == chosen and exact.how_chosen("cpu") == "fixed"
    reasons = manifest.describe_process("jax", [], exact.how_chosen("gpu"))["inexact_because"]
    assert ["by timing" in reason for reason in reasons] == [True] * (chosen == "by timing")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cartpole_swingup", "ant_run"])
def test_no_update_has_a_sum_without_a_fixed_order(name):
    source = load_file(ROOT / "experiments" / f"{name}.py").experiment
    config, env, network, _ = build(dataclasses.replace(source, engine="jax"))
    update = functools.partial(algorithm.update, config, env, network)
    trace = jax.make_jaxpr(update)(programs.abstract_state(config, env, network))
    assert exact.unordered_in(trace) == []


def test_a_sum_without_a_fixed_order_is_found(monkeypatch):
    config, env, network, _ = build(load_file(TOY).experiment)

    def apply(params, observation, carry):
        output, carry = network.apply(params, observation, carry)
        value = output.value.reshape(-1)
        place = (value > 0).astype(jnp.int32)
        total = jnp.zeros(2).at[place].add(value)
        return output._replace(value=output.value + 0.0 * total.sum()), carry

    compiled = programs.compile_programs(
        config, env, network._replace(apply=apply), Evaluation(number=0), False, Shards()
    )
    assert compiled.unordered
    assert all("tests/runs/test_manifest.py" in place for place in compiled.unordered)
    reasons = manifest.with_unordered(manifest.exactness("jax", "fixed"), compiled.unordered)[
        "inexact_because"
    ]
    assert reasons[0].startswith("a sum without a fixed order: scatter")


def test_a_run_on_c_imports_no_other_engine():
    """MJX takes most of a second to import, Warp two; a run on engine `c` needs neither."""
    lines = [
        "import sys",
        "import purerl",
        "from purerl.experiment import objects",
        "from purerl.runs import manifest",
        "chosen = purerl.find('ant_run')",
        "setup = objects.build(chosen)",
        "manifest.describe_process(setup.engine, [chosen.build_env, chosen.build_network])",
        "assert setup.engine == 'c'",
        "print([name for name in sys.modules if name in ('mujoco.mjx', 'warp')])",
    ]
    words = [sys.executable, "-c", "\n".join(lines)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("found", "cure"),
    [
        (["versions.jax: 0.10.2 -> 0.11.2"], "the command it was begun with"),
        (["settings.ppo.gamma: 0.99 -> 0.9", resume.EDITED], "Put the file back"),
        (["vmapped_seeds: {'first': 1, 'number': 3} -> (absent)"], "--num-seeds and --seed"),
        (["schedule.log_every: 1 -> 2", "settings.ppo.num_steps: 9 -> 99"], "go_on.md"),
        (["settings.ppo.num_steps: 9 -> 99"], "Leave out what differs; to train longer, copy"),
        (["settings.ppo.num_steps: 9 -> 99", "source.mine: ab -> cd"], "edited, or give every"),
        (["model: ab -> cd"], "Put back what was edited of the MuJoCo model"),
        (["model: ab -> cd", "settings.env.mass: 1.0 -> 2.0"], "Leave out what differs"),
        (
            ["source.pk.mine: ab -> (absent)", "source.purerl_experiment_mine: (absent) -> ab"],
            "in the folder it was begun in",
        ),
    ],
)
def test_a_refusal_to_go_on_names_what_helps(found, cure):
    """The command that a run was begun with helps neither an edited file nor a longer run."""
    assert cure in resume.cure(found)


@pytest.mark.slow
@pytest.mark.parametrize("platform", ["cuda", "gpu"])
def test_a_platform_that_jax_lacks_is_named_in_one_line(platform):
    # Of the CPU's JAX; where a GPU is, `rocm` is the one that is missing.
    platform = platform if jax.default_backend() == "cpu" else "rocm"
    words = [sys.executable, "-m", "purerl.run", str(TOY), "--name", "nowhere"]
    ended = subprocess.run(
        words,
        env=os.environ | {"JAX_PLATFORMS": platform},
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert ended.returncode == 2 and len(ended.stderr.splitlines()) == 1
    assert f"JAX_PLATFORMS is {platform}" in ended.stderr and "unset it" in ended.stderr
