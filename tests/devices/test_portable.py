"""`--portable`: a run with bits that are not those of one processor."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

import purerl
from purerl.core.errors import USAGE
from purerl.devices import compilation
from purerl.exact import xla_flags
from purerl.runs import manifest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
TOY = ROOT / "tests" / "runs" / "toy_experiment.py"
# One run in peace, and one that is stopped half-way. Elsewhere the second may go on.
SCRIPT = """
import contextlib, itertools, sys
import purerl
from purerl.training import train
toy, runs = sys.argv[1:]
purerl.train(toy, name="whole", runs=runs, portable=True)
asked = itertools.chain([False] * 4, itertools.repeat(True))
train.signals.stop_signals = lambda _: contextlib.nullcontext(lambda: next(asked))
with contextlib.suppress(purerl.StoppedError):
    purerl.train(toy, name="half", runs=runs, portable=True)
"""


def command(*words):
    words = [sys.executable, "-m", "purerl.run", str(TOY), *words]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True)


def facts(folder):
    return json.loads((folder / "manifest.json").read_text())


def last(folder):
    return json.loads((folder / "metrics.jsonl").read_text().splitlines()[-1])


@pytest.fixture
def portable(monkeypatch):
    """An environment as `--portable` sets it; the one of before comes back."""
    for name in ("XLA_FLAGS", "NPROC"):
        monkeypatch.setenv(name, "")
    monkeypatch.setattr(xla_flags, "jax_has_begun", lambda: False)
    xla_flags.set_portable_flags()


def test_a_portable_run_goes_on_as_one_and_names_no_processor(tmp_path):
    script = [sys.executable, "-c", SCRIPT, str(TOY), str(tmp_path)]
    subprocess.run(script, cwd=ROOT, check=True)
    whole, half = (tmp_path / "toy_experiment" / name for name in ("whole", "half"))
    kind = "x86-64 with AVX2, portable"
    assert facts(whole)["device"] == {"platform": "cpu", "kind": kind, "threads": 1}
    model = manifest.processor("model name")
    assert model and model not in (whole / "manifest.json").read_text()
    assert last(half)["update"] < last(whole)["update"]
    done = command("--runs", str(tmp_path), "--name", "half", "--resume")
    assert not done.returncode, done.stderr
    assert last(half)["digest"] == last(whole)["digest"]
    assert facts(half)["device"]["kind"] == kind and "allowed_changes" not in facts(half)


@pytest.mark.usefixtures("compiled_quickly")
def test_a_run_of_this_processor_does_not_go_on_as_a_portable_one(tmp_path):
    purerl.train(TOY, runs=tmp_path, name="own")
    done = command("--runs", str(tmp_path), "--name", "own", "--resume", "--portable")
    assert done.returncode == USAGE
    assert f"device.kind: {manifest.processor('model name')} -> x86-64" in done.stderr


def test_where_portable_bits_cannot_be_had_is_one_line(tmp_path, monkeypatch):
    def refused(words):
        with pytest.raises(purerl.UserError, match=words) as error:
            purerl.train(TOY, runs=tmp_path, portable=True)
        assert "\n" not in str(error.value) and not list(tmp_path.iterdir())

    jax.devices()
    refused("JAX has begun with other flags")
    monkeypatch.setattr(xla_flags, "jax_has_begun", lambda: False)
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_max_isa=SSE4_2")
    refused("XLA_FLAGS has --xla_cpu_max_isa=SSE4_2; portable bits need --xla_cpu_max_isa=AVX:")
    old = {"flags": "fpu avx fma", "model name": "An old one"}
    monkeypatch.setattr(manifest, "processor", old.get)
    refused(r"AVX2 and FMA, and this one \(An old one\) has not both; leave out --portable")


def test_portable_bits_are_not_those_of_a_gpu(portable):
    with pytest.raises(purerl.UserError, match="JAX computes on a gpu; set JAX_PLATFORMS=cpu"):
        manifest._device_kind(SimpleNamespace(platform="gpu", device_kind="H100"))


def test_a_program_that_needs_a_library_is_one_line(portable):
    whole = compilation.jit("init", lambda x: jnp.linalg.eigh(x)[0])
    with pytest.raises(purerl.UserError, match=r"computes \w+, traced at .* Leave out --portable"):
        whole.trace(jnp.eye(3))


def test_what_picks_the_cpu_among_devices_is_no_difference(portable, monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    named = manifest.describe_process("c", [])
    monkeypatch.delenv("JAX_PLATFORMS")
    assert manifest.differences(named, manifest.describe_process("c", [])) == []


def test_a_manifest_that_does_not_say_so_is_not_portable():
    for facts in ({}, {"device": 3}, {"device": {"kind": "H100"}}):
        assert not manifest.was_portable(facts)
    assert manifest.was_portable({"device": {"kind": manifest.PORTABLE}})
