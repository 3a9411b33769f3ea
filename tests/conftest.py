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
jax.config.update("jax_persistent_cache_min_compile_time_secs", 2.0)
jax.config.update("jax_debug_key_reuse", True)  # a key consumed twice raises
