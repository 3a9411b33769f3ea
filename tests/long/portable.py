"""Has this machine the portable bits? Two machines' answers are compared by `diff`.

python -m tests.long.portable > here.txt             # operations, and all golden runs
python -m tests.long.portable cartpole ant_c > here.txt

One fact a line. Lines of `machine` may differ. If no line of `version` or `library` does, none of
`operation` (which finds where bits part) and of `run` (a digest of each golden run) may.
"""

import functools
import hashlib
import os
import platform
import sys
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

from purerl import exact
from tests.golden.__main__ import RUNS, compute  # leaves JAX the CPU alone

exact.set_portable_flags()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from purerl.runs import manifest  # noqa: E402

LIBRARIES = ("libjax_common", "libmujoco", "libscipy_openblas-", "libm.", "libm-")
TELLING = {"avx2", "fma", "avx512f", "avx512_fp16", "avx_vnni", "amx_tile", "fma4"}
ELEMENTWISE: dict[str, Callable] = {
    "atan2": lambda x: jnp.arctan2(x, x[::-1]),
    "cos": jnp.cos,
    "divide": lambda x: 1 / x,
    "erf_inv": lambda x: jax.lax.erf_inv(jnp.tanh(x)),
    "exp": jnp.exp,
    "expm1": jnp.expm1,
    "fma": lambda x: x * x[::-1] + x,
    "log": lambda x: jnp.log(jnp.abs(x)),
    "log1p": lambda x: jnp.log1p(jnp.abs(x)),
    "normal": lambda x: jax.random.normal(jax.random.key(1), x.shape),
    "power": lambda x: jnp.abs(x) ** x[::-1],
    "rsqrt": lambda x: jax.lax.rsqrt(jnp.abs(x)),
    "silu": jax.nn.silu,
    "sin": jnp.sin,
    "softplus": jax.nn.softplus,
    "sqrt": lambda x: jnp.sqrt(jnp.abs(x)),
    "sum": jnp.sum,
    "tanh": jnp.tanh,
    "variance": jnp.var,
}
PRODUCTS = [(16, 60, 128), (64, 128, 1), (128, 1024, 128), (1, 300, 7), (33, 4097, 65)]


def main(names: list[str]) -> int:
    """Prints everything; returns the exit code."""
    for line in (*machine(), *versions(), *operations()):
        print(line, flush=True)
    for name in names or RUNS:
        digests = compute([name])[name]
        print("run", name, *digests.values(), flush=True)
    for line in libraries():  # of those that have been loaded by now
        print(line)
    return 0


def machine() -> Iterator[str]:
    """Yields what may differ."""
    flags = sorted(TELLING & set(manifest.processor("flags").split()))
    yield f"machine processor: {manifest.processor('model name')}, {' '.join(flags)}"
    caches = sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*/size"))
    yield f"machine caches: {' '.join(path.read_text().strip() for path in caches)}"
    yield f"machine cores: {os.cpu_count()}"


def versions() -> Iterator[str]:
    """Yields what must be the same, or the bits are not."""
    yield f"version python {platform.python_version()}"
    yield f"version libc {' '.join(platform.libc_ver())}"
    for name in (*manifest.PACKAGES, "scipy"):
        yield f"version {name} {metadata.version(name)}"


def libraries() -> Iterator[str]:
    """Yields the content of the loaded libraries that compute."""
    maps = Path("/proc/self/maps").read_text().splitlines()
    paths = {line.split(maxsplit=5)[5] for line in maps if "/" in line}
    for path in sorted(map(Path, paths), key=lambda path: path.name):
        if path.name.startswith(LIBRARIES):
            content = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
            yield f"library {path.name} {content}"


def operations() -> Iterator[str]:
    """Yields digests of single operations, so that one sees where bits part."""
    x = numbers(4099)
    for name, function in ELEMENTWISE.items():
        yield f"operation {name} {digest(function, x)}"
    for m, k, n in PRODUCTS:
        a, b = numbers(m, k), numbers(k, n)
        ways = [(jnp.dot, a, b), (lambda a, b: jnp.dot(b.T, a.T), a, b)]
        ways += [(lambda a, b: a.T @ b, a.T.copy(), b), (lambda a, b: a @ b.T, a, b.T.copy())]
        yield f"operation product of {m}x{k}x{n} {' '.join(digest(*way) for way in ways)}"
    matrix = np.tril(numbers(40, 40)) / 64  # numpy's products would be another library's
    matrix = matrix + matrix.T + 9 * np.eye(40, dtype=np.float32)
    yield f"operation cholesky {digest(jnp.linalg.cholesky, matrix)}"
    yield f"operation qr {digest(lambda x: jnp.linalg.qr(x)[0], matrix)}"
    solve = functools.partial(jax.scipy.linalg.solve_triangular, lower=True)
    yield f"operation triangular_solve {digest(solve, matrix, matrix[0])}"


def numbers(*shape: int) -> np.ndarray:
    """Returns the same numbers everywhere: integers, divided by a power of two."""
    drawn = np.random.default_rng(sum(shape)).integers(-(2**20), 2**20, shape)
    return (drawn / 2**18).astype(np.float32)


def digest(function: Callable, *arguments: np.ndarray) -> str:
    """Computes as a run does; returns a digest of the result."""
    result = jax.jit(exact.without_libraries(function))(*arguments)
    return hashlib.sha256(np.asarray(result).tobytes()).hexdigest()[:12]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
