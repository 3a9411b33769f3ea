"""JAX's primitives as nodes of ONNX, operator set 17; one function for each kind."""

from collections.abc import Callable
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
            made = write_step(self, step, list(step.inputs))
            many = made if isinstance(made, list) else [made]
            self.names |= dict(zip(step.outputs, many, strict=True))
        for value, name in zip(program.outputs, outputs, strict=True):
            whole = self.name(value)
            self.nodes.append(helper.make_node("Identity", [whole], [name]))

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
            self.shapes[key] = self._shape(key)
        return self.node("Expand", value, self.shapes[key])

    def _shape(self, shape: tuple[int, ...]) -> str:
        """Adds a shape with the batch's size where there is a 0."""
        size = self.node("Slice", self.node("Shape", self.first), _one(0), _one(1))
        return self.node("Concat", *(_one(n) if n else size for n in shape), axis=0)


def _one(number: int) -> np.ndarray:
    return np.asarray([number], np.int64)


Writer = Callable[[Nodes, Step, list[Any]], Any]

# JAX's name -> ONNX's, of the same arguments.
_SAME = {
    "abs": "Abs", "acos": "Acos", "add": "Add", "add_any": "Add", "and": "And", "asin": "Asin",
    "atan": "Atan", "ceil": "Ceil", "copy": "Identity", "copy_p": "Identity", "cos": "Cos",
    "cosh": "Cosh", "div": "Div", "eq": "Equal", "erf": "Erf", "exp": "Exp", "floor": "Floor",
    "ge": "GreaterOrEqual", "gt": "Greater", "le": "LessOrEqual", "log": "Log",
    "logistic": "Sigmoid", "lt": "Less", "max": "Max", "min": "Min", "mul": "Mul", "neg": "Neg",
    "not": "Not", "optimization_barrier": "Identity", "or": "Or", "pow": "Pow", "sign": "Sign",
    "sin": "Sin", "sinh": "Sinh", "sqrt": "Sqrt", "stop_gradient": "Identity", "sub": "Sub",
    "tan": "Tan", "tanh": "Tanh",
}  # fmt: skip


def write_step(graph: Nodes, step: Step, inputs: list[Any]) -> Any:
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


def _reshape(graph: Nodes, step: Step, inputs: list[Any]) -> Any:
    """At most one size depends on the batch: the one that ONNX works out."""
    return graph.node("Reshape", inputs[0], _integers(sizes(step.result.shape, -1)))


def _broadcast(graph: Nodes, step: Step, inputs: list[Any]) -> Any:
    shape, axes = step.result.shape, step.params["broadcast_dimensions"]
    (old,) = (t.shape for t in step.types[:1])
    aligned = [1] * len(shape)
    for axis, size in zip(axes, sizes(old, -1), strict=True):
        aligned[axis] = size
    return graph.batched(graph.node("Reshape", inputs[0], _integers(aligned)), shape)


def _concatenate(graph: Nodes, step: Step, inputs: list[Any]) -> Any:
    whole = [graph.batched(x, t.shape) for x, t in zip(inputs, step.types, strict=True)]
    return graph.node("Concat", *whole, axis=step.params["dimension"])


def _slice(graph: Nodes, step: Step, inputs: list[Any]) -> Any:
    starts, stops = step.params["start_indices"], step.params["limit_indices"]
    axes = [i for i, stop in enumerate(sizes(stops, -1)) if stop >= 0]  # the batch stays whole
    strides = step.params["strides"] or (1,) * len(starts)
    first, last, by = (_integers(values[i] for i in axes) for values in (starts, stops, strides))
    return graph.node("Slice", inputs[0], first, last, _integers(axes), by)


def _split(graph: Nodes, step: Step, inputs: list[Any]) -> Any:
    parts = _integers(step.params["sizes"])
    return graph.node("Split", inputs[0], parts, outputs=len(parts), axis=step.params["axis"])


def _dot(graph: Nodes, step: Step, inputs: list[Any]) -> Any:
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


def _select(graph: Nodes, step: Step, inputs: list[Any]) -> Any:
    if len(inputs) != 3 or step.types[0].dtype != bool:
        raise UserError("The network selects between more than two cases: use --format jax.")
    return graph.node("Where", inputs[0], inputs[2], inputs[1])


def _convert(graph: Nodes, step: Step, inputs: list[Any]) -> Any:
    kinds = {"float32": 1, "int32": 6, "int64": 7, "bool": 9, "float64": 11}
    name = np.dtype(step.params["new_dtype"]).name
    if name not in kinds:
        raise UserError(f"The network computes in {name}, not float32: use --format jax.")
    return graph.node("Cast", inputs[0], to=kinds[name])


def _power(graph: Nodes, step: Step, inputs: list[Any]) -> Any:
    return graph.node("Pow", inputs[0], _number(step, step.params["y"]))


def _expm1(graph: Nodes, step: Step, inputs: list[Any]) -> Any:
    """Below 1, 2 t / (1 - t) with t = tanh(x/2): there e^x - 1 loses digits."""
    x, one = inputs[0], _number(step, 1)
    half = graph.node("Mul", graph.node("Min", x, one), _number(step, 0.5))
    t = graph.node("Tanh", half)
    small = graph.node("Div", graph.node("Add", t, t), graph.node("Sub", one, t))
    large = graph.node("Sub", graph.node("Exp", x), one)
    return graph.node("Where", graph.node("Less", x, one), small, large)


def _sum(graph: Nodes, step: Step, inputs: list[Any]) -> Any:
    return graph.node("ReduceSum", inputs[0], _integers(step.params["axes"]), keepdims=0)


def _reduce(kind: str) -> Writer:
    def write(graph: Nodes, step: Step, inputs: list[Any]) -> Any:
        return graph.node(kind, inputs[0], axes=list(step.params["axes"]), keepdims=0)

    return write


def _clamp(graph: Nodes, step: Step, inputs: list[Any]) -> Any:
    low, x, high = inputs
    return graph.node("Min", graph.node("Max", x, low), high)


_OTHERS: dict[str, Writer] = {
    "broadcast_in_dim": _broadcast,
    "clamp": _clamp,
    "concatenate": _concatenate,
    "convert_element_type": _convert,
    "dot_general": _dot,
    "erfc": lambda g, s, x: g.node("Sub", _number(s, 1), g.node("Erf", x[0])),
    "expand_dims": _reshape,
    "expm1": _expm1,
    "integer_pow": _power,
    "log1p": lambda g, s, x: g.node("Log", g.node("Add", x[0], _number(s, 1))),
    "ne": lambda g, s, x: g.node("Not", g.node("Equal", *x)),
    "reduce_max": _reduce("ReduceMax"),
    "reduce_min": _reduce("ReduceMin"),
    "reduce_sum": _sum,
    "reshape": _reshape,
    "rsqrt": lambda g, s, x: g.node("Reciprocal", g.node("Sqrt", x[0])),
    "select_n": _select,
    "slice": _slice,
    "split": _split,
    "square": lambda g, s, x: g.node("Mul", x[0], x[0]),
    "squeeze": _reshape,
    "transpose": lambda g, s, x: g.node("Transpose", x[0], perm=list(s.params["permutation"])),
}
