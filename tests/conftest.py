"""What all tests share."""

import os
import tempfile

# Reported cure for hangs of XLA's CPU pool on large vmapped programs, and bits that do not depend
# on the number of cores; it must be set before JAX starts.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

import jax  # noqa: E402

# Compiling MJX takes most of the time of these tests.
jax.config.update(
    "jax_compilation_cache_dir", os.path.join(tempfile.gettempdir(), "purerl-test-compilations")
)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_debug_key_reuse", True)  # a key consumed twice raises

# Files that take a minute or more, the longest first: begun last, one would run alone at the end.
LONGEST = ("shards", "run", "physics", "seeds", "ppo", "suite", "probes", "kill", "envs")


def pytest_collection_modifyitems(items):
    rank = {f"test_{name}.py": number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))
