"""The cache of compiled programs: damage, other programs' entries, several processes at once."""

import os
import subprocess
import sys
import threading
import types
from pathlib import Path

import jax
import pytest
from hypothesis import given, strategies as st
from jax._src.compilation_cache import compress_executable, decompress_executable

from purerl.devices import compilation, compile_cache
from purerl.devices.compile_cache import MARK, CheckedPath

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent.parent
# Two programs that are kept: where the code of one stands under the name of the other, JAX raises.
SCRIPT = """
import jax, jax.numpy as jnp
from purerl.devices.compilation import set_up_jax
set_up_jax(True)
def first(x): return jnp.sin(x).sum()
def second(x, y): return jnp.cos(x) * y, y + x
print(float(jax.jit(first)(jnp.arange(9.0))), float(jax.jit(second)(1.0, 2.0)[0]))
"""


def compute(folder):
    """Computes in a process of its own; returns what it said, without and with an error."""
    env = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(folder), "PYTHONWARNINGS": "ignore"}
    words = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(words, cwd=ROOT, env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, f"exit {done.returncode}: {done.stderr[-500:]}"
    return done.stdout, done.stderr


def entry_of(folder, name):
    (path,) = folder.glob(f"jit_{name}-*-cache")
    return path


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def cache(tmp_path):
    """A cache with two programs, and what they say."""
    folder = tmp_path / "cache"
    return folder, compute(folder)


def break_code(path):
    """Puts instructions that no processor has where the machine code is, beneath the checksum."""
    content, mark, digest = path.read_bytes().partition(MARK)
    code = bytearray(decompress_executable(content))  # zstandard's, where that is installed
    start = code.index(b"\x7fELF") + 64
    code[start : start + 128] = b"\x0f\x0b" * 64
    path.write_bytes(compress_executable(bytes(code)) + mark + digest)


def swap(path):
    path.write_bytes(entry_of(path.parent, "second").read_bytes())


def cut(path):
    path.write_bytes(path.read_bytes()[:-9])


def empty(path):
    path.write_bytes(b"")


@pytest.mark.parametrize(
    ("damage", "told"), [(break_code, True), (swap, True), (cut, False), (empty, False)]
)
def test_a_program_that_is_not_as_it_was_stored_is_compiled_anew(cache, damage, told):
    folder, said = cache
    path = entry_of(folder, "first")
    stored = contents(folder)
    assert compute(folder) == said and contents(folder) == stored  # taken as they are
    damage(path)
    again, error = compute(folder)
    assert again == said[0]
    assert (
        error
        == said[1] + told * f"purerl: {path} is not as it was stored, so it is compiled anew.\n"
    )
    assert contents(folder).keys() == stored.keys()
    healed = contents(folder)
    assert compute(folder) == said and contents(folder) == healed


@given(st.binary(max_size=200), st.data())
def test_one_changed_byte_is_seen(tmp_path_factory, program, data):
    path = CheckedPath(tmp_path_factory.mktemp("cache", numbered=True) / "jit_x-0-cache")
    assert not path.exists()
    path.write_bytes(program)
    assert path.exists() and path.read_bytes() == program
    raw = bytearray(Path(path).read_bytes())
    raw[data.draw(st.integers(0, len(raw) - 1))] ^= data.draw(st.integers(1, 255))
    Path(path).write_bytes(raw)
    assert not path.exists()
    with pytest.raises(FileNotFoundError):
        path.read_bytes()


def test_what_others_keep_in_the_folder_stays_and_is_not_taken(tmp_path):
    plain = tmp_path / "jit_x-0-cache"
    plain.write_bytes(b"theirs")
    assert not CheckedPath(plain).exists() and plain.read_bytes() == b"theirs"
    for name in ("jit_x-0-atime", ".lockfile"):
        CheckedPath(tmp_path / name).write_bytes(b"whole")
        assert (
            (tmp_path / name).read_bytes() == CheckedPath(tmp_path / name).read_bytes() == b"whole"
        )
    assert CheckedPath(tmp_path).exists()


def test_others_can_read_what_is_stored(tmp_path):
    path = CheckedPath(tmp_path / "jit_x-0-cache")
    path.write_bytes(compress_executable(b"program"))
    assert decompress_executable((tmp_path / path.name).read_bytes()) == b"program"


def test_many_write_and_read_one_entry_at_once(tmp_path, capsys):
    """What is read is one of the programs that were written, whole; no draft is left."""
    path = CheckedPath(tmp_path / "jit_x-0-cache")
    programs = [bytes([i]) * (100_000 + i) for i in range(4)]
    path.write_bytes(programs[0])
    wrong = []

    def work(program):
        for _ in range(50):
            path.write_bytes(program)
            if path.read_bytes() not in programs or not path.exists():
                wrong.append(program[0])

    threads = [threading.Thread(target=work, args=(program,)) for program in programs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong and not capsys.readouterr().err
    assert [found.name for found in tmp_path.iterdir()] == [path.name]


def test_a_folder_that_is_not_local_is_left_to_jax():
    before = jax.config.values["jax_compilation_cache_dir"]
    try:
        compile_cache.use("gs://bucket/cache")
        assert jax.config.values["jax_compilation_cache_dir"] == "gs://bucket/cache"
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_a_folder_that_cannot_be_written_is_no_hindrance(cache):
    """`/proc` refuses the superuser too."""
    assert compute("/proc/purerl")[0] == cache[1][0]


def test_what_is_kept_is_made_once_and_anew_when_it_is_damaged(tmp_path, monkeypatch):
    monkeypatch.setattr(compile_cache, "in_use", lambda: str(tmp_path))
    made = []

    def make():
        made.append(len(made))
        return b"%d" % len(made)

    assert [compile_cache.kept("x", make) for _ in range(3)] == [b"1"] * 3
    assert compile_cache.kept("y", make) == b"2"
    (tmp_path / "kept" / "x-cache").write_bytes(b"1")  # without its hash
    assert [compile_cache.kept("x", make) for _ in range(2)] == [b"3"] * 2
    with monkeypatch.context() as off:
        values = {"jax_enable_compilation_cache": False}
        config = types.SimpleNamespace(values=values)
        off.setattr(compile_cache, "jax", types.SimpleNamespace(config=config))
        assert compile_cache.kept("x", make) == b"4"
    for nowhere in ("", "gs://bucket", "/proc/purerl"):
        monkeypatch.setattr(compile_cache, "in_use", lambda folder=nowhere: folder)
        compile_cache.kept("x", make)
    assert len(made) == 7 and [x.name for x in tmp_path.iterdir()] == ["kept"]


def test_the_folder_is_told_without_the_prefix():
    folder = compilation.set_up_jax(cache=True)
    assert folder == compilation.set_up_jax(cache=True) == os.environ["JAX_COMPILATION_CACHE_DIR"]
    assert jax.config.values["jax_compilation_cache_dir"] == f"{compile_cache.PREFIX}{folder}"


def test_a_cache_whose_folder_cannot_be_made_is_off_and_said_so(tmp_path):
    (tmp_path / "file").touch()
    folder = str(tmp_path / "file" / "jax")
    found = subprocess.run(
        [sys.executable, "-c", SET_UP], env=os.environ | {"JAX_COMPILATION_CACHE_DIR": folder},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert found.stdout == f"off: {folder} cannot be made (Not a directory)\n"


SET_UP = "from purerl.devices.compilation import set_up_jax; print(set_up_jax(True))"
