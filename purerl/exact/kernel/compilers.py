"""A kernel's text compiled: by g++ for this CPU, by NVRTC for a GPU.

What was compiled is kept in JAX's compilation cache, if there is one, by the text, the compiler and
what it compiles for.
"""

import ctypes
import functools
import hashlib
import importlib.util
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax

from purerl.exact.kernel.text import Text

CPU_WORDS = "-O1 -std=c++17 -w -shared -fPIC -fno-strict-aliasing -ffp-contract=off".split()  # noqa: SIM905
# Quotients and roots as XLA's own on a GPU: off by 2 in the last place at most.
GPU_WORDS = ("--std=c++17", "--prec-div=false", "--prec-sqrt=false")
# Bytes of shared memory that a block can have, by compute capability; a chip that is not here has
# at least what the smallest has.
SHARED = {80: 163, 86: 99, 87: 163, 89: 99, 90: 227, 100: 227, 103: 227, 120: 99}
MOST_WARPS = 16  # of a block: 512 threads, which may have 128 registers each


class CompilerError(RuntimeError):
    """There is no compiler, or it has refused; the message says which and why."""


class Block(NamedTuple):
    """How many environments a block of a GPU steps, and with how many warps each.

    Where few have room, more warps hide how long each has to wait. No bit depends on them.
    """

    environments: int
    warps: int = 1


ALONE = Block(1)


def source(text: Text, block: Block = ALONE) -> str:
    """Returns the whole text for a compiler; `block` is for a GPU."""
    prelude = resources.files("purerl.exact.kernel").joinpath("prelude.h").read_text()
    head = f"#define ENVIRONMENTS {block.environments}\n#define WARPS {block.warps}\n"
    return head + text.body.replace("PRELUDE\n", prelude, 1)


def block_of(text: Text, chip: int) -> Block:
    """Returns the block of a compute capability, as 90; CompilerError if it has no room."""
    room = SHARED.get(chip, min(SHARED.values())) * 1024
    fit = room // (4 * text.memory)
    if not fit:
        raise CompilerError(
            f"A kernel needs {4 * text.memory:,} bytes of shared memory for an environment, and a "
            f"block of compute capability {chip / 10} has {room:,}: leave this step to XLA."
        )
    environments = min(MOST_WARPS, fit)
    return Block(environments, MOST_WARPS // environments)


# --- C++ on this CPU ---


def on_cpu(text: Text) -> Callable[..., None]:
    """Returns the kernel as a C function of pointers; CompilerError if there is no g++."""
    compiler = shutil.which("g++")
    if not compiler:
        raise CompilerError("No g++ is found: install it (apt-get install g++).")
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=True)

    def make(whole: str) -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            path, library = Path(folder) / "kernel.cpp", Path(folder) / "kernel.so"
            path.write_text(whole)
            words = [compiler, *CPU_WORDS, str(path), "-o", str(library)]
            done = subprocess.run(words, capture_output=True, text=True)
            if done.returncode:
                raise CompilerError(f"g++ refuses a kernel: {done.stderr[:500]}")
            return library.read_bytes()

    path = kept(source(text), (version.stdout, *CPU_WORDS), "so", make)
    return ctypes.CDLL(str(path)).kernel


# --- PTX for a GPU ---


def for_gpu(text: Text, chip: int) -> str:
    """Returns PTX of the kernel for a compute capability, as 90; CompilerError without NVRTC."""
    words = (*GPU_WORDS, f"--gpu-architecture=compute_{chip}")
    whole = source(text, block_of(text, chip))
    about = nvrtc_version(), *words
    return kept(whole, about, "ptx", lambda x: _ptx(_nvrtc(), x, words)).read_text()


def nvrtc_version() -> str:
    """Returns the version of NVRTC, on which a GPU's bits depend: it joins products and sums."""
    version = [ctypes.c_int(), ctypes.c_int()]
    _nvrtc().nvrtcVersion(*map(ctypes.byref, version))
    return ".".join(str(x.value) for x in version)


def _ptx(library: Any, whole: str, words: tuple[str, ...]) -> bytes:
    program = ctypes.c_void_p()

    def ask(name: str, *args: Any) -> None:
        error = getattr(library, f"nvrtc{name}")(*args)
        if error:
            raise CompilerError(f"NVRTC's {name} fails with error {error}.")

    def answer(name: str) -> bytes:
        size = ctypes.c_size_t()
        ask(f"Get{name}Size", program, ctypes.byref(size))
        found = ctypes.create_string_buffer(size.value)
        ask(f"Get{name}", program, found)
        return found.raw.rstrip(b"\0")

    ask("CreateProgram", ctypes.byref(program), whole.encode(), b"kernel.cu", 0, None, None)
    try:
        array = (ctypes.c_char_p * len(words))(*(word.encode() for word in words))
        if library.nvrtcCompileProgram(program, len(words), array):
            log = answer("ProgramLog").decode(errors="replace")
            raise CompilerError(f"NVRTC refuses a kernel: {log[:500]}")
        return answer("PTX")
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))


@functools.cache
def _nvrtc() -> Any:
    """Loads NVRTC: of the wheel that JAX's CUDA brings, or of an installed CUDA."""
    spec = importlib.util.find_spec("nvidia")
    folders = [Path(x) for x in (spec.submodule_search_locations or [])] if spec else []
    wheels = [path for folder in folders for path in sorted(folder.glob("*/lib/libnvrtc.so.*"))]
    for name in (*map(str, wheels), "libnvrtc.so", "libnvrtc.so.13", "libnvrtc.so.12"):
        try:
            for builtins in Path(name).parent.glob("libnvrtc-builtins.so.*") if "/" in name else ():
                ctypes.CDLL(str(builtins))  # it looks for them by name, in the system's folders
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise CompilerError("No NVRTC is found: it is in the wheels that JAX's CUDA needs.")


# --- what was compiled ---


def key_of(whole: str, words: tuple[str, ...]) -> str:
    """Returns the name of what a compiler makes of a text: all that it depends on."""
    return hashlib.sha256("\0".join((whole, *words)).encode()).hexdigest()[:32]


def kept(whole: str, words: tuple[str, ...], kind: str, make: Callable[[str], bytes]) -> Path:
    """Returns the file of what was compiled; a process that is killed leaves no half of one."""
    folder = _folder()
    path = folder / f"{key_of(whole, words)}.{kind}"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        made = make(whole)
        with tempfile.NamedTemporaryFile(dir=folder, delete=False) as file:
            file.write(made)
        Path(file.name).replace(path)
    return path


@functools.cache
def how_texts_are_written() -> bytes:
    """Returns the source of all that a text depends on besides its trace."""
    return b"".join(x.read_bytes() for x in sorted(Path(__file__).parent.parent.rglob("*.py")))


def _folder() -> Path:
    # Before "://" may stand who reads it. What then is no absolute path is of no folder here.
    cache = Path((jax.config.jax_compilation_cache_dir or "").rpartition("://")[2])
    return cache / "kernels" if cache.is_absolute() else Path(_of_this_process().name)


@functools.cache
def _of_this_process() -> tempfile.TemporaryDirectory:
    return tempfile.TemporaryDirectory(prefix="kernels-")
