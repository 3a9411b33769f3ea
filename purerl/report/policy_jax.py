"""A policy as a program of XLA, by `jax.export`: any network, any program that has JAX."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import export
from jax._src import config

from purerl.machine.files import write_answer
from purerl.report.flat_program import batched
from purerl.report.policy_file import policy_function, remembering
from purerl.runs.loaded_run import Run

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")


def write_jax(run: Run, file: Path) -> Callable[[Any], np.ndarray]:
    """Writes a policy by `jax.export`; returns that of the file, of observations [N, ...]."""
    policy = policy_function(run)
    arguments = batched((policy.observation, policy.memory), *export.symbolic_shape("batch"))
    with config.hlo_source_file_canonicalization_regex(".*/"):  # or it holds our folders' names
        exported = export.export(jax.jit(policy.act), platforms=PLATFORMS)(*arguments)
    content = exported.serialize()
    write_answer(file, bytes(content))
    return remembering(policy, export.deserialize(bytearray(content)).call)
