"""A policy as a program of XLA, by `jax.export`: any network, any program that has JAX."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import export

from purerl.core.records import PyTree
from purerl.machine.files import write_answer
from purerl.report.flat_program import batched
from purerl.report.policy_function import PolicyFunction, policy_function
from purerl.runs.loaded_run import Run

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")


def write_jax(run: Run, file: Path) -> Callable[[Any], np.ndarray]:
    """Writes a policy by `jax.export`; returns that of the file, of observations [N, ...]."""
    policy = policy_function(run)
    arguments = batched((policy.observation, policy.memory), *export.symbolic_shape("batch"))
    exported = export.export(jax.jit(policy.act), platforms=PLATFORMS)(*arguments)
    content = exported.serialize()
    write_answer(file, bytes(content))
    return remembering(policy, export.deserialize(bytearray(content)).call)


def remembering(
    policy: PolicyFunction, call: Callable[[PyTree, PyTree], tuple[Any, PyTree]]
) -> Callable[[Any], np.ndarray]:
    """Returns a function of the whole observation that carries the memory from call to call."""
    memory: PyTree = None

    def act(observation: Any) -> np.ndarray:
        nonlocal memory
        if isinstance(policy.observation, dict):
            observation = {name: observation[name] for name in policy.observation}
        if memory is None:
            number = jax.tree.leaves(observation)[0].shape[0]
            memory = jax.tree.map(lambda x: np.zeros((number, *x.shape), x.dtype), policy.memory)
        action, memory = call(observation, memory)
        return np.asarray(action)

    return act
