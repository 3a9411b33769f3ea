"""A kernel as an operation of JAX: batches, what a GPU's program says, what is kept on the disk."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl import exact
from purerl.exact.kernel import compilers, compiling, launch
from tests.exact.kernel import needs_compiler


def function(x, y):
    return {"a": x["n"] + y @ y, "b": x["of"] > y[0]}


EXAMPLE = {"n": np.int32(1), "of": np.ones((2, 3), np.float32)}, np.ones(4, np.float32)


@pytest.fixture(scope="module")
def kernel():
    return exact.compile_kernel(function, *EXAMPLE)


@needs_compiler
def test_it_is_called_as_the_function_is(kernel):
    for run in (kernel, jax.jit(kernel)):
        found, wanted = run(*EXAMPLE), function(*EXAMPLE)
        assert jax.tree.map(lambda x: (x.shape, x.dtype), found) == {
            "a": ((), np.float32),
            "b": ((2, 3), bool),
        }
        assert found["a"] == wanted["a"] and (found["b"] == wanted["b"]).all()
    with pytest.raises(ValueError, match="the kernel is for"):
        kernel(EXAMPLE[1], EXAMPLE[0])


@needs_compiler
def test_arguments_of_other_shapes_are_refused(kernel):
    longer = EXAMPLE[0], np.ones(5, np.float32)
    with pytest.raises(ValueError, match=r"float32\[5\].*the kernel is for .*float32\[4\]"):
        kernel(*longer)


def test_vmap_makes_one_call_of_any_batch(kernel):
    x = {"n": np.arange(6, dtype=np.int32).reshape(2, 3), "of": np.ones((2, 3), np.float32)}
    y = np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32)
    over = lambda f: jax.vmap(jax.vmap(f, ({"n": 0, "of": None}, None)), ({"n": 1, "of": None}, 0))  # noqa: E731
    found, wanted = over(kernel)(x, y), over(function)(x, y)
    assert found["a"].shape == (3, 2) and found["b"].shape == (3, 2, 2, 3)
    np.testing.assert_allclose(found["a"], wanted["a"], rtol=1e-6)
    assert (found["b"] == wanted["b"]).all()
    assert str(jax.make_jaxpr(over(kernel))(x, y)).count("kernel[") == 1


@needs_compiler
def test_a_batch_may_stand_on_any_axis(kernel):
    rows = [
        np.ones((n, 3), d)
        for (n, _), d in zip(kernel.text.inputs, (np.int32, np.float32, np.float32), strict=True)
    ]
    rows[2][:, 1] = 2.0
    found = jax.vmap(lambda *x: launch.run(kernel.text, *x), (1, 1, 1))(*rows)
    np.testing.assert_array_equal(found[0][:, 0], [5.0, 17.0, 5.0])


def batched(number):
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((number, *np.shape(x)), np.asarray(x).dtype), EXAMPLE
    )


def lowered(kernel, number):
    traced = jax.jit(jax.vmap(kernel)).trace(*batched(number))
    return traced.lower(lowering_platforms=("cuda",)).as_text()


def test_a_gpus_program_has_one_call_with_a_warp_for_each_environment(kernel, monkeypatch):
    monkeypatch.setattr(compilers, "for_gpu", lambda text, chip: f"PTX for {chip}")
    for number, blocks in ((1, 1), (16, 1), (17, 2), (4096, 256)):
        text = lowered(kernel, number)
        assert text.count("__gpu$xla.gpu.ptx") == 1 and 'kernel_data = "PTX for 90"' in text
        assert f"grid_x = {blocks} : i32" in text and "block_x = 512 : i32" in text
        assert f"shared_mem_bytes = {16 * 4 * kernel.text.memory} : i32" in text
        assert f"dense<{number}> : tensor<1xi32>" in text


def test_a_block_has_as_many_environments_as_have_room(kernel):
    text = kernel.text
    assert compilers.block_of(text, 90) == (16, 1)
    assert compilers.block_of(text._replace(memory=5000), 90) == (11, 1)
    assert compilers.block_of(text._replace(memory=5000), 89) == (5, 3)
    with pytest.raises(compilers.CompilerError, match=r"240,000 bytes .* leave this step to XLA"):
        compilers.block_of(text._replace(memory=60_000), 90)


def test_what_is_compiled_is_kept_by_all_that_it_depends_on(monkeypatch, tmp_path):
    made = []

    def make(whole):
        made.append(whole)
        return whole.encode()

    monkeypatch.setattr(compilers, "_folder", lambda: tmp_path / "kernels")
    for _ in range(2):
        for whole, words in (("a", ("1",)), ("b", ("1",)), ("a", ("2",)), ("a", ("1", ""))):
            path = compilers.kept(whole, words, "ptx", make)
            assert path.read_text() == whole
    assert made == ["a", "b", "a", "a"]
    assert len(list((tmp_path / "kernels").iterdir())) == 4


def test_a_text_is_kept_by_its_trace_and_its_constants(monkeypatch, tmp_path):
    monkeypatch.setattr(compilers, "_folder", lambda: tmp_path)
    plain, read = compiling.reading.read, []
    monkeypatch.setattr(compiling.reading, "read", lambda x: read.append(x) or plain(x))

    def made(table, factor):
        table, x = np.float32(table), jnp.ones(3)
        return exact.compile_kernel(lambda x: jnp.cos(x * table) * factor, x)

    one, again = made([1, 2, 3], 0.1), made([1, 2, 3], 0.1)
    assert len(read) == 1 and one.text == again.text and hash(one.text) == hash(again.text)
    # They differ in a constant array that no trace shows, and in a digit that might not be shown.
    others = made([1, 2, 4], 0.1), made([1, 2, 3], np.float32(0.1) + np.float32(1e-8))
    assert len({one.text.body, *(x.text.body for x in others)}) == len(read) == 3


def test_a_compiler_that_fails_leaves_nothing(monkeypatch, tmp_path):
    monkeypatch.setattr(compilers, "_folder", lambda: tmp_path)
    with pytest.raises(ZeroDivisionError):
        compilers.kept("a", (), "ptx", lambda _: 1 // 0)
    assert not list(tmp_path.iterdir())


def test_nvrtc_makes_ptx_of_the_text(kernel):
    try:
        ptx = compilers.for_gpu(kernel.text, 90)
    except compilers.CompilerError as error:
        pytest.skip(str(error))
    assert ".visible .entry kernel(" in ptx and ".target sm_90" in ptx
    with pytest.raises(compilers.CompilerError, match="NVRTC refuses a kernel: .*error"):
        compilers.for_gpu(kernel.text._replace(body="PRELUDE\nno C"), 90)


def test_agreement_counts_what_is_off():
    from purerl.exact.kernel.compiling import agreement

    wanted = np.array([[1.0, 2.0, np.nan], [3.0, 4.0, 5.0]])
    assert agreement(wanted, wanted).agrees
    found = wanted.copy()
    found[1, 0] = np.nan
    one = agreement(found, wanted)
    assert not one.agrees and one.off == 1 and one.size == 6
    found[1, 0] = 3.3
    one = agreement(found, wanted)
    assert one.error == pytest.approx(0.3 / np.sqrt(55)) and one.worst == pytest.approx(
        0.3 / np.sqrt(50)
    )
    assert not one.agrees


def test_a_kernel_has_no_derivative(kernel):
    with pytest.raises(
        NotImplementedError, match="ifferentiation rule for 'kernel' not implemented"
    ):
        jax.jvp(lambda y: kernel(EXAMPLE[0], y)["a"], (jnp.ones(4),), (jnp.ones(4),))


@pytest.mark.parametrize(
    ("cache", "kept"),
    [("/a/b", True), ("purerl-checked:///a/b", True), ("gs://a/b", False), (None, False)],
)
def test_kernels_are_kept_in_the_cache_of_this_machine_alone(monkeypatch, cache, kept):
    config = types.SimpleNamespace(jax_compilation_cache_dir=cache)
    monkeypatch.setattr(compilers, "jax", types.SimpleNamespace(config=config))
    assert (str(compilers._folder()) == "/a/b/kernels") == kept
    assert compilers._folder().is_absolute()
