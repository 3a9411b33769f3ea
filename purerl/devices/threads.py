"""XLA's threads on a CPU: how many there are, and how many engine `jax` can bear.

jaxlib's factorisation of a batch waits, on one of XLA's threads, for parts that it gives to the
others. MJX has two that do not depend on each other: begun at once on two threads, each waits for
the other for ever (docs/explanation/engines.md). One thread waits for nobody. What vmapped seeds
begin with is made for one after another, for the same reason (`programs.in_turn`).
"""

import os
from pathlib import Path

from purerl.exact.xla_flags import jax_has_begun

STALLING = 2


def cpu_threads() -> int:
    """Returns the size of XLA's CPU thread pool: NPROC where it is set, else the usable cores."""
    pinned = _pinned()
    return int(pinned) if pinned.isdigit() else len(os.sched_getaffinity(0))


def _pinned() -> str:
    return os.environ.get("NPROC", "") or os.environ.get("PJRT_NPROC", "")


def leave_one(engine: str) -> None:
    """Sets NPROC=1 where an engine would stop on XLA's threads, unless the user has set NPROC.

    The physics of an ant is as fast on one as on two. It does nothing once JAX has begun, for
    several devices on a CPU, which need a thread each, and where a GPU computes.
    """
    stalls = engine == "jax" and cpu_threads() == STALLING and not _pinned()
    several = "platform_device_count" in os.environ.get("XLA_FLAGS", "")
    several |= "JAX_NUM_CPU_DEVICES" in os.environ
    on_cpu = os.environ.get("JAX_PLATFORMS") == "cpu" or not Path("/dev/nvidiactl").exists()
    if stalls and on_cpu and not several and not jax_has_begun():
        os.environ["NPROC"] = "1"
