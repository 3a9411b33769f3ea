"""Which of a function's two programs is run: one kernel, or XLA's. 20 s."""

import json
import re
import threading
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from purerl import exact, run
from purerl.exact.kernel import compilers, text
from purerl.physics import engine_mjx
from purerl.physics.interface import Physics
from tests.exact.kernel import needs_compiler
from tests.exact.kernel.test_models import PENDULUM

ROWS = np.random.default_rng(0).normal(size=(5, 40)).astype(np.float32)


def doubled(x):
    return {"sine": jnp.sin(x), "sum": (x * x).sum()}


def by_xla(x):
    """The same, marked: what is off by 1e-6 tells who computed it."""
    return {"sine": jnp.sin(x) + 1e-6, "sum": (x * x).sum() * 3 / 3}


def reached(_, example):
    rows = ROWS[:, : example.shape[0]]
    return (rows,), jax.vmap(by_xla)(rows)


@pytest.fixture(autouse=True)
def nothing_kept(monkeypatch, tmp_path):
    monkeypatch.setattr(compilers, "_folder", lambda: tmp_path / "kernels")


@needs_compiler
def test_a_kernel_is_taken_that_has_been_compared_and_has_xlas_derivative():
    said, compared = [], []

    def watched(traced, example):
        compared.append(example)
        (rows,), wanted = reached(traced, example)
        assert np.allclose(jax.vmap(traced)(rows)["sine"], wanted["sine"], atol=2e-6)
        return (rows,), wanted

    function = exact.with_kernel(doubled, by_xla, watched, said.append)
    found = jax.jit(jax.vmap(function))(ROWS)
    assert said == ["one kernel, by g++"] and [x.shape for x in compared] == [(40,)]
    marked = jax.jit(jax.vmap(by_xla))(ROWS)
    assert (np.abs(found["sine"] - marked["sine"]) > 5e-7).all(), "XLA computed it"
    assert np.allclose(found["sine"], marked["sine"], atol=2e-6)
    slope = jax.grad(lambda x: function(x)["sum"])(ROWS[0])
    np.testing.assert_allclose(slope, 2 * ROWS[0], 1e-5)
    exact.with_kernel(doubled, by_xla, watched, said.append)(ROWS[0])
    assert len(compared) == 1, "it is compared once on a machine"
    function(ROWS[0][:7])
    assert said == ["one kernel, by g++"] * 3 and [x.shape for x in compared] == [(40,), (7,)]


def unknown(x):
    return {"sine": jnp.fft.fft(x).real, "sum": x.sum()}


def large(x):
    y = jax.lax.fori_loop(0, 2, lambda _, c: jnp.sin(c[::-1]), jnp.tile(x, 200))
    return {"sine": y[:40], "sum": y.sum()}


def wrong(x):
    return {"sine": jnp.sin(x) * 1.1, "sum": (x * x).sum()}


@needs_compiler
@pytest.mark.parametrize(
    "function, why",
    [
        (unknown, "XLA: No kernel computes .* of numbers of complex64"),
        (large, "XLA: a block of this GPU has room for"),
        (wrong, r"XLA: the kernel's results differ, Agreement\(error=0\.\d"),
    ],
)
def test_xla_computes_what_no_kernel_can_and_says_why(function, why):
    said = []
    chosen = exact.with_kernel(function, by_xla, reached, said.append)
    found = jax.jit(jax.vmap(chosen))(ROWS)
    np.testing.assert_array_equal(found["sine"], jax.jit(jax.vmap(by_xla))(ROWS)["sine"])
    (line,) = said
    assert re.match(why, line), line


@needs_compiler
def test_on_a_gpu_nvrtc_compiles_beside_xla(monkeypatch):
    """As on a GPU, with g++'s kernel. Neither is asked where it is known how the two agree."""
    both, began, said, plain = threading.Barrier(2, timeout=30), [], [], text.written

    def for_gpu(*_):
        began.append("NVRTC")
        both.wait()  # an error if the other does not begin
        if not said:
            raise compilers.CompilerError("NVRTC refuses it.")

    def watched(*args):
        began.append("XLA")
        both.wait()
        return reached(*args)

    monkeypatch.setattr(text, "written", lambda x: began.append("text") or plain(x))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(compilers, "nvrtc_version", lambda: "13.0")
    monkeypatch.setattr(compilers, "for_gpu", for_gpu)
    for _ in range(3):
        exact.with_kernel(doubled, by_xla, watched, said.append)(ROWS[0])
    assert said == ["XLA: NVRTC refuses it."] + ["one kernel, by NVRTC 13.0"] * 2
    assert sorted(began) == ["NVRTC"] * 2 + ["XLA"] * 2 + ["text"]


@pytest.mark.slow
@needs_compiler
@pytest.mark.usefixtures("compiled_quickly")
@pytest.mark.parametrize("cores", [2, 4])
def test_a_gpus_engine_steps_by_a_kernel_what_is_small(monkeypatch, cores):
    """With four cores it is compared with XLA on a CPU, whatever computes."""
    monkeypatch.setattr(engine_mjx, "usable_cores", lambda: cores)
    assert (engine_mjx._to_compare_on() is None) == (cores == 2)
    physics = Physics(mujoco.MjModel.from_xml_string(PENDULUM), ("xpos",), 3, "jax")
    make = partial(engine_mjx.JaxEngine, physics.model, physics._engine.record, (), 3)
    engine = make(platform="gpu")
    state, _ = physics.init(physics.model.qpos0, np.ones(1))
    mass = jnp.asarray(physics.model.body_mass, jnp.float32) * np.linspace(1, 2, 3)[:, None]
    states, ctrl = jax.tree.map(lambda x: jnp.stack([x] * 3), state), jnp.ones((3, 1))

    def stepped(engine):
        return jax.vmap(lambda *x: engine.step(*x[:2], {"body_mass": x[2]}))(states, ctrl, mass)

    results = [stepped(e) for e in (engine, physics._engine)]
    assert engine.stepped_by == ["one kernel, by g++"] and physics.stepped_by is None
    for x, y in zip(*map(jax.tree.leaves, results), strict=True):
        np.testing.assert_allclose(x, y, 1e-5, 1e-6)
    assert len(set(np.ravel(results[0][0].qvel).tolist())) == 3, "each has a mass of its own"
    monkeypatch.setattr(engine_mjx, "MOST_OF_A_KERNEL", -1)
    assert make(platform="gpu").stepped_by is None


def test_where_jax_has_no_cpu_a_kernel_is_compared_where_it_runs(monkeypatch):
    def none(backend):
        raise RuntimeError("Unknown backend cpu")

    monkeypatch.setattr(engine_mjx, "usable_cores", lambda: 4)
    monkeypatch.setattr(jax, "local_devices", none)
    assert engine_mjx._to_compare_on() is None


@needs_compiler
@pytest.mark.slow
@pytest.mark.usefixtures("compiled_quickly")
def test_a_run_says_what_steps_it(monkeypatch, tmp_path, capsys):
    """20 s. As on a GPU, with the kernel's C++."""
    plain = engine_mjx.JaxEngine.__init__
    monkeypatch.setattr(engine_mjx.JaxEngine, "__init__", lambda *x: plain(*x[:5], platform="gpu"))
    words = [
        "--engine",
        "jax",
        "--ppo.num-steps",
        "256",
        "--ppo.num-envs",
        "8",
        "--ppo.rollout-length",
        "32",
    ]
    words += ["--ppo.num-minibatches", "2", "--evaluation.number", "0", "--runs", str(tmp_path)]
    assert run.main(["cartpole_swingup", *words]) == 0
    facts = json.loads((tmp_path / "cartpole_swingup/seed1/manifest.json").read_text())
    assert facts["stepped_by"] == ["one kernel, by g++"]
    assert "stepped by   one kernel, by g++" in capsys.readouterr().out
