"""A policy as a graph of ONNX: the steps of JAX's own program, each as a node."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import onnx
import onnxruntime
from onnx import helper

from purerl.core.records import Array, PyTree
from purerl.machine.files import write_answer
from purerl.report import flat_program, onnx_nodes, policy_file
from purerl.runs.loaded_run import Run

IR_VERSION = 8  # the file format that goes with the operator set


def write_onnx(run: Run, file: Path) -> Callable[[Any], np.ndarray]:
    """Writes a policy as ONNX; returns that of the file, of observations [N, ...].

    Raises:
      UserError: the network computes what ONNX or this writer has not.
    """
    policy = policy_file.policy_function(run)
    model = build_model(policy, policy_file.control_range(run), policy_file.origin(run))
    onnx.checker.check_model(model, full_check=True)
    write_answer(file, model.SerializeToString())
    return policy_file.remembering(policy, caller(file))


def names(prefix: str, tree: PyTree) -> list[str]:
    """Returns a name for each leaf: `memory`, or `memory_0`, `memory_1`; of a dict, its keys'."""
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(tree)]
    said = [jax.tree_util.keystr(path, simple=True, separator="_") for path in paths]
    return [f"{prefix}_{name}" if name else prefix for name in said]


def build_model(
    policy: policy_file.PolicyFunction, limits: np.ndarray | None, notes: dict[str, Any]
) -> onnx.ModelProto:
    """Returns the model: observation and memory in; action, control and the next memory out.

    Args:
      policy: the function.
      limits: [A, 2] what actions -1 and 1 are as controls; None: no control comes out.
      notes: of the model, name -> text.
    """

    def outputs(observation: PyTree, memory: PyTree) -> tuple[Array, list[Array], PyTree]:
        action, memory = policy.act(observation, memory)
        if limits is None:
            return action, [], memory
        low, high = limits.T
        return action, [low + 0.5 * (action + 1.0) * (high - low)], memory

    arguments = (policy.observation, policy.memory)
    program = flat_program.flat_program(outputs, *arguments)
    given = names("observation", policy.observation) + names("memory", policy.memory)
    taken = ["action", "control"][: 1 + (limits is not None)] + names("next_memory", policy.memory)
    made = jax.tree.leaves(jax.eval_shape(outputs, *flat_program.batched(arguments)))
    nodes = onnx_nodes.Nodes(given)
    nodes.write(program, taken)
    read = [_info(n, x.shape, x) for n, x in zip(given, jax.tree.leaves(arguments), strict=True)]
    results = [_info(name, x.shape[1:], x) for name, x in zip(taken, made, strict=True)]
    graph = helper.make_graph(nodes.nodes, "policy", read, results, nodes.constants)
    opset = [helper.make_opsetid("", onnx_nodes.OPSET)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=IR_VERSION)
    helper.set_model_props(model, {name: str(value) for name, value in notes.items()})
    return model


def _info(name: str, shape: tuple[int, ...], like: Any) -> onnx.ValueInfoProto:
    kind = onnx.TensorProto.UINT8 if like.dtype == np.uint8 else onnx.TensorProto.FLOAT
    return helper.make_tensor_value_info(name, kind, ["batch", *shape])


def caller(file: Path) -> Callable[[PyTree, PyTree], tuple[np.ndarray, PyTree]]:
    """Returns the file's function of (observation, memory), by onnxruntime on the CPU."""
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    given = session.get_inputs()
    taken = [entry.name for entry in session.get_outputs() if entry.name != "control"]

    def call(observation: PyTree, memory: PyTree) -> tuple[np.ndarray, PyTree]:
        leaves, tree = jax.tree.flatten(memory)
        values = [*jax.tree.leaves(observation), *leaves]
        arrays = {e.name: np.asarray(x) for e, x in zip(given, values, strict=True)}
        action, *following = session.run(taken, arrays)
        return action, jax.tree.unflatten(tree, following)

    return call
