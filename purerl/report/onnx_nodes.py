"""JAX's primitives as nodes of ONNX, operator set 17; one function for each kind."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper

from purerl.core.errors import UserError
from purerl.report.flat_program import Program, Step, Value, sizes

OPSET = 17  # of onnxruntime 1.12 (2022) and newer


class Nodes:
    """The nodes of a graph and its constants, as they are collected."""

    def __init__(self, given: list[str]) -> None:
        """Begins with the names of the inputs."""
        self.names: dict[int, str] = dict(enumerate(given))  # value -> name
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self.shapes: dict[tuple[int, ...], str] = {}  # with 0 for the batch -> name
        self.first = given[0]

    def write(self, program: Program, outputs: list[str]) -> None:
        """Adds a program's steps; its outputs get their names."""
        for step in program.steps:
            made = write_step(self, step, step.inputs)
            many = made if isinstance(made, list) else [made]
            self.names |= dict(zip(step.outputs, many, strict=True))
        for value, name in zip(program.outputs, outputs, strict=True):
            self.nodes.append(helper.make_node("Identity", [self.name(value)], [name]))

    def name(self, value: Value | str) -> str:
        """Returns the name of a value, a constant being added under a new one."""
        if isinstance(value, str):
            return value
        if isinstance(value, int):
            return self.names[value]
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(value, order="C"), name))
        return name

    def node(self, kind: str, *inputs: Value | str, outputs: int = 1, **attributes: Any) -> Any:
        """Adds a node; returns the name of its output, or a list of them."""
        made = [f"{kind.lower()}_{len(self.nodes)}_{i}" for i in range(outputs)]
        self.nodes.append(helper.make_node(kind, [*map(self.name, inputs)], made, **attributes))
        return made if outputs > 1 else made[0]

    def batched(self, value: Value | str, shape: tuple[Any, ...]) -> str:
        """Returns a value at its full shape, where it was only broadcast so far."""
        if isinstance(value, int):
            return self.name(value)
        key = tuple(sizes(shape, 0))
        if key == shape:
            return self.node("Expand", value, np.asarray(shape, np.int64))
        if key not in self.shapes:
            zero, one = _integers([0]), _integers([1])
            size = self.node("Slice", self.node("Shape", self.first), zero, one)
            parts = (_integers([n]) if n else size for n in key)
            self.shapes[key] = self.node("Concat", *parts, axis=0)
        return self.node("Expand", value, self.shapes[key])


Inputs = Sequence[Any]
Writer = Callable[[Nodes, Step, Inputs], Any]

# JAX's name -> ONNX's, of the same arguments; most differ by the first letter alone.
_SAME = {name: name.capitalize() for name in (
    "abs", "acos", "add", "and", "asin", "atan", "ceil", "cos", "cosh", "div", "erf", "exp",
    "floor", "log", "max", "min", "mul", "neg", "not", "or", "pow", "sign", "sin", "sinh", "sqrt",
    "sub", "tan", "tanh",
)}  # fmt: skip
_SAME |= dict.fromkeys(("copy", "copy_p", "optimization_barrier", "stop_gradient"), "Identity")
_SAME |= {"add_any": "Add", "eq": "Equal", "logistic": "Sigmoid"}
_SAME |= {"ge": "GreaterOrEqual", "gt": "Greater", "le": "LessOrEqual", "lt": "Less"}


def write_step(graph: Nodes, step: Step, inputs: Inputs) -> Any:
    """Adds the nodes of a step; returns the name of its output, or a list of them.

    Raises:
      UserError: ONNX has no such step here.
    """
    if step.name in _SAME:
        return graph.node(_SAME[step.name], *inputs)
    if step.name not in _OTHERS:
        raise UserError(
            f"The network computes {step.name!r} (of JAX), which purerl does not write as ONNX: "
            "use --format jax, or another layer."
        )
    return _OTHERS[step.name](graph, step, inputs)


def _number(step: Step, value: float) -> np.ndarray:
    return np.asarray(value, step.result.dtype)


def _integers(values: Any) -> np.ndarray:
    return np.asarray(list(values), np.int64)


def _reshape(graph: Nodes, step: Step, inputs: Inputs) -> Any:
    """At most one size depends on the batch: the one that ONNX works out."""
    return graph.node("Reshape", inputs[0], _integers(sizes(step.result.shape, -1)))


def _broadcast(graph: Nodes, step: Step, inputs: Inputs) -> Any:
    shape, axes = step.result.shape, step.params["broadcast_dimensions"]
    aligned = [1] * len(shape)
    for axis, size in zip(axes, sizes(step.types[0].shape, -1), strict=True):
        aligned[axis] = size
    return graph.batched(graph.node("Reshape", inputs[0], _integers(aligned)), shape)


def _concatenate(graph: Nodes, step: Step, inputs: Inputs) -> Any:
    whole = [graph.batched(x, t.shape) for x, t in zip(inputs, step.types, strict=True)]
    return graph.node("Concat", *whole, axis=step.params["dimension"])


def _slice(graph: Nodes, step: Step, inputs: Inputs) -> Any:
    starts, stops = step.params["start_indices"], step.params["limit_indices"]
    axes = [i for i, stop in enumerate(sizes(stops, -1)) if stop >= 0]  # the batch stays whole
    strides = step.params["strides"] or (1,) * len(starts)
    first, last, by = (_integers(values[i] for i in axes) for values in (starts, stops, strides))
    return graph.node("Slice", inputs[0], first, last, _integers(axes), by)


def _split(graph: Nodes, step: Step, inputs: Inputs) -> Any:
    parts = _integers(step.params["sizes"])
    return graph.node("Split", inputs[0], parts, outputs=len(parts), axis=step.params["axis"])


def _dot(graph: Nodes, step: Step, inputs: Inputs) -> Any:
    """x [..., H] @ kernel [H, ...]: layers. Other products stand in no usual network."""
    (left, right), batch = step.params["dimension_numbers"]
    ranks = [len(t.shape) for t in step.types]
    if any(batch) or ranks[1] != 2 or tuple(left) != (ranks[0] - 1,):
        raise UserError(
            "The network has a product of matrices that is no layer's (inputs @ kernel), which "
            "purerl does not write as ONNX: use --format jax."
        )
    kernel = graph.node("Transpose", inputs[1], perm=[1, 0]) if right[0] else inputs[1]
    return graph.node("MatMul", inputs[0], kernel)


def _select(graph: Nodes, step: Step, inputs: Inputs) -> Any:
    if len(inputs) != 3 or step.types[0].dtype != bool:
        raise UserError("The network selects between more than two cases: use --format jax.")
    return graph.node("Where", inputs[0], inputs[2], inputs[1])


def _convert(graph: Nodes, step: Step, inputs: Inputs) -> Any:
    kinds = {"float32": 1, "int32": 6, "int64": 7, "bool": 9, "float64": 11}
    name = np.dtype(step.params["new_dtype"]).name
    if name not in kinds:
        raise UserError(f"The network computes in {name}, not float32: use --format jax.")
    return graph.node("Cast", inputs[0], to=kinds[name])


def _expm1(graph: Nodes, step: Step, inputs: Inputs) -> Any:
    """Below 1, 2 t / (1 - t) with t = tanh(x/2): there e^x - 1 loses digits."""
    x, one = inputs[0], _number(step, 1)
    half = graph.node("Mul", graph.node("Min", x, one), _number(step, 0.5))
    t = graph.node("Tanh", half)
    small = graph.node("Div", graph.node("Add", t, t), graph.node("Sub", one, t))
    large = graph.node("Sub", graph.node("Exp", x), one)
    return graph.node("Where", graph.node("Less", x, one), small, large)


def _reduce(kind: str) -> Writer:
    return lambda g, s, x: g.node(kind, x[0], axes=list(s.params["axes"]), keepdims=0)


_OTHERS: dict[str, Writer] = {
    "broadcast_in_dim": _broadcast,
    "clamp": lambda g, s, x: g.node("Min", g.node("Max", x[1], x[0]), x[2]),
    "concatenate": _concatenate,
    "convert_element_type": _convert,
    "dot_general": _dot,
    "erfc": lambda g, s, x: g.node("Sub", _number(s, 1), g.node("Erf", x[0])),
    "expand_dims": _reshape,
    "expm1": _expm1,
    "integer_pow": lambda g, s, x: g.node("Pow", x[0], _number(s, s.params["y"])),
    "log1p": lambda g, s, x: g.node("Log", g.node("Add", x[0], _number(s, 1))),
    "ne": lambda g, s, x: g.node("Not", g.node("Equal", *x)),
    "reduce_max": _reduce("ReduceMax"),
    "reduce_min": _reduce("ReduceMin"),
    "reduce_sum": lambda g, s, x: g.node(
        "ReduceSum", x[0], _integers(s.params["axes"]), keepdims=0
    ),
    "reshape": _reshape,
    "rsqrt": lambda g, s, x: g.node("Reciprocal", g.node("Sqrt", x[0])),
    "select_n": _select,
    "slice": _slice,
    "split": _split,
    "square": lambda g, s, x: g.node("Mul", x[0], x[0]),
    "squeeze": _reshape,
    "transpose": lambda g, s, x: g.node("Transpose", x[0], perm=list(s.params["permutation"])),
}
