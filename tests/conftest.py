"""What all tests share."""

import atexit
import contextlib
import ctypes.util
import gc
import itertools
import os
import shutil
import sys
import tempfile

# Reported cure for hangs of XLA's CPU pool on large vmapped programs (not of those that
# `purerl/training/console.py` tells of), and bits that do not depend on the number of cores: to be
# set before JAX starts.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

# Compiling takes most of the time of these tests: it is done once for all their processes.
COMPILED = os.path.join(tempfile.gettempdir(), "purerl-test-compilations")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", COMPILED)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

# Python keeps what it compiled: each of some hundred processes compiles purerl in a second and a
# half where it may not.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A fork is refused where a mapping is larger than the memory; a rodent reserves 3 GB, untouched.
os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")

# The list of known experiments; not that of who tests.
os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="purerl-test-state-")
atexit.register(shutil.rmtree, os.environ["XDG_STATE_HOME"], ignore_errors=True)

import hypothesis  # noqa: E402
import jax  # noqa: E402
import pytest  # noqa: E402

from purerl.core.errors import RunError  # noqa: E402
from purerl.report.opengl import open_gl  # noqa: E402
from purerl.training import seeds, train  # noqa: E402
from tests import quick  # noqa: E402

# The same examples every time: a failure belongs to the change that is tested.
hypothesis.settings.register_profile("same", derandomize=True, deadline=None)
hypothesis.settings.load_profile("same")

jax.config.update("jax_debug_key_reuse", True)  # a key consumed twice raises

# Files that take most, the longest first (460 to 45 s of a core, nothing compiled, 28 and 29
# November 2026): begun last, one would run alone at the end.
LONGEST = ("shards", "run", "suite", "models", "interface", "golden", "power_cuts", "algorithm")
LONGEST += ("probes", "kill", "io_faults", "export", "seeds", "parts", "threads")

# JAX keeps all that a process compiled: 6 GB in one of two at the end of all tests, and a machine
# of 8 GB then starts no other program.
MOST_MEMORY = 2 * 10**9


def resident_bytes() -> int:
    """Of this process."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture
def stop_after(monkeypatch):
    """Makes the runs that follow stop by themselves, when they ask for the n-th time."""

    def use(questions: int) -> None:
        left = itertools.chain(itertools.repeat(False, questions), itertools.repeat(True))
        signals = contextlib.nullcontext(lambda: next(left))
        monkeypatch.setattr(train.signals, "stop_signals", lambda _: signals)

    return use


@pytest.fixture(scope="session")
def opengl():
    """Skips a test that draws where nothing can be drawn, and says what to install."""
    try:
        open_gl(16, 16).free()
    except RunError as error:
        if ctypes.util.find_library("OSMesa"):
            raise  # it needs no driver, so this is a fault of ours
        pytest.skip(str(error))


@pytest.fixture
def compiled_quickly(monkeypatch):
    """What this test compiles, purerl's own programs too, is ready in a quarter of the time.

    For tests in which bits do not matter.
    """
    monkeypatch.setattr(jax, "jit", quick.Jit)


@pytest.fixture(scope="module")
def file_is_compiled_quickly():
    """The same for all tests of a file, and for what they share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax, "jit", quick.Jit)
        yield


@pytest.fixture(scope="session")
def kept_programs():
    """`seeds._compile` of this process's tests that let runs share what they compile."""
    return quick.kept(seeds._compile)


@pytest.fixture(scope="module")
def programs_are_kept(kept_programs):
    """Runs of a file with equal settings share their programs: to trace them is half of a toy's.

    What a process compiles by itself is tested where runs are processes.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(seeds, "_compile", kept_programs)
        yield


@pytest.fixture(scope="module", autouse=True)
def garbage_is_collected_after_a_file():
    """Tracing makes millions of objects, no garbage: looking for it was a sixth of the time."""
    gc.disable()
    yield
    gc.enable()
    if resident_bytes() > MOST_MEMORY:
        jax.clear_caches()  # what is asked for again comes from the files of `COMPILED`
        gc.unfreeze()
    gc.collect()
    gc.freeze()  # what is left (JAX's caches) is not looked through again


def pytest_collection_modifyitems(config, items):
    if "nightly" not in config.option.markexpr:
        nightly = [item for item in items if item.get_closest_marker("nightly")]
        config.hook.pytest_deselected(items=nightly)
        items[:] = [item for item in items if item not in nightly]
    rank = {f"test_{name}.py": number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))
