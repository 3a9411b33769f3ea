"""How programs are compiled: the cache, levels of optimisation, side by side in threads."""

import contextlib
import functools
import gc
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax

from purerl import exact
from purerl.core.errors import UserError
from purerl.core.records import Metrics, PyTree
from purerl.devices import compile_cache
from purerl.exact.portable import LibraryError

# Up to so many cores, the evaluation is compiled when it is first needed, or the first update
# would wait for it. With 16 cores all is compiled side by side: brax's ant came to its first
# evaluation on a GPU in 22 s instead of 39.
FEW_CORES = 7
# LLVM's optimisation level on a CPU, 3 for all others: a program that runs once, or that waits for
# MuJoCo, shall be ready soon. For an ant on engine `c`, `init` takes 1.5 s of a core, not 3.3, and
# `collect` 3.9 s, not 4.7, and it runs as fast (at level 0 it takes 2.4, and is slower by 8%).
LEVELS = {"init": 0, "collect": 1}


def as_it_is(state: Any) -> Any:
    """Returns a state that is where it should be."""
    return state


class Compiling(NamedTuple):
    """An update that is being compiled, and how a state gets to it and back."""

    # Waits for it; returns it, and how many seconds each of its programs took.
    finish: Callable[[], tuple[Callable[[Any], tuple[Any, Metrics]], dict[str, float]]]
    unordered: list[str]  # its sums without a fixed order
    judged: PyTree  # shapes of what an evaluation is given
    spread: Callable[[Any], Any] = as_it_is  # onto several devices
    fetch: Callable[[Any], Any] = as_it_is  # back onto one
    to_judge: Callable[[Any], Any] = as_it_is  # what an evaluation needs, onto one


def set_up_jax(cache: bool) -> str:
    """Sets the options of JAX on which bits depend, and the cache of compiled programs.

    Returns the cache's folder; "off" without `cache`, or if the environment has none
    (JAX_ENABLE_COMPILATION_CACHE=false), or if its folder cannot be made.
    """
    jax.config.update("jax_threefry_partitionable", True)
    jax.config.update("jax_default_prng_impl", "threefry2x32")
    if not cache or not jax.config.values["jax_enable_compilation_cache"]:
        jax.config.update("jax_enable_compilation_cache", False)
        return "off"
    # JAX has read JAX_COMPILATION_CACHE_DIR by now, if it is set.
    folder = compile_cache.in_use() or str(cache_folder())
    try:
        if "://" not in folder:  # a bucket is JAX's own
            Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        jax.config.update("jax_enable_compilation_cache", False)
        return f"off: {folder} cannot be made ({error.strerror})"
    compile_cache.use(folder)
    return compile_cache.in_use()


def cache_folder() -> Path:
    """Returns the folder for compiled programs, where the user keeps caches (XDG_CACHE_HOME)."""
    caches = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not caches.is_absolute():  # the freedesktop.org specification takes no other
        caches = Path.home() / ".cache"
    return caches / "purerl" / "jax"


@contextlib.contextmanager
def no_collection() -> Iterator[None]:
    """Keeps Python from looking for garbage: tracing makes millions of objects, and no garbage.

    An ant's first update with MJX, on two cores, came after 10 s instead of 12.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def shapes(tree: PyTree, sharding: Any = None) -> PyTree:
    """Returns the shapes and dtypes of a tree of anything that has them, laid out as `sharding`."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), tree)


def jit(name: str, function: Callable, **options: Any) -> Any:
    """Returns `jax.jit` of a run's program, at its level of LLVM wherever it is compiled.

    At another level its bits are others.
    """
    function = portable(function)
    on_cpu = name in LEVELS and jax.default_backend() == "cpu"
    level = {"xla_backend_optimization_level": LEVELS[name]} if on_cpu else None
    return jax.jit(function, compiler_options=level, **options)


def portable(function: Callable) -> Callable:
    """Returns a program as it is, or in a portable run one that calls no library."""
    if not exact.is_portable():
        return function
    own = exact.without_libraries(function)

    @functools.wraps(own)
    def traced(*arguments: Any) -> Any:
        try:
            return own(*arguments)
        except LibraryError as error:
            raise UserError(f"{error} Leave out --portable, or that.") from error

    return traced


def start(name: str, traced: Any) -> Future[tuple[Any, float]]:
    """Compiles a traced program in a thread of its own; the future has it, and the seconds."""
    begin, lowered = time.perf_counter(), traced.lower()
    pool = ThreadPoolExecutor(1, f"purerl-compile-{name}")
    future = pool.submit(lambda: (compiled(lowered), time.perf_counter() - begin))
    pool.shutdown(wait=False)
    return future


def compiled(lowered: Any) -> Any:
    """Compiles a lowered program; without Triton's reductions what XLA cannot compile with them."""
    try:
        return lowered.compile()
    except jax.errors.JaxRuntimeError as error:
        # On a GPU a joint of 128 and 284 features before a layer was one, with several seeds.
        if not str(error).startswith("UNIMPLEMENTED"):
            raise
        return lowered.compile(compiler_options={exact.TRITON_REDUCTIONS: False})


def when_needed(name: str, function: Any, example: PyTree) -> Callable[..., Any]:
    """Returns a jitted function, compiled beside the others, or on few cores when it is called."""
    if len(os.sched_getaffinity(0)) <= FEW_CORES:
        return function
    program = start(name, function.trace(example))
    return lambda *arguments: program.result()[0](*arguments)


def unordered(traced: Any) -> list[str]:
    """Lists the sums of a traced program whose order nothing fixes on a GPU."""
    return sorted({f"{s.primitive} at {s.source}" for s in exact.unordered_in(traced.jaxpr)})
