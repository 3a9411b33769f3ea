"""A JAX function as a flat list of steps, with what is constant computed: to be written elsewhere.

Functions within functions are opened, steps that no output needs are left out. The first axis of
every input is the batch. It is traced with a size that nothing else has, and may have any other.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from purerl.core.records import PyTree
from purerl.exact import traces

# A prime: what it divides depends on the batch. No array of that size is made.
BATCH = 1_000_003

Value = int | np.ndarray  # the number of an input or of a step's result, or a constant


class Step(NamedTuple):
    """One primitive of JAX."""

    name: str  # "add", "dot_general", ...
    params: dict[str, Any]
    inputs: tuple[Value, ...]
    outputs: tuple[int, ...]
    types: tuple[Any, ...]  # of the inputs
    result: Any  # type of the first output


class Program(NamedTuple):
    """Steps in order; the inputs are numbered 0, 1, ..., as the arguments' leaves stand."""

    steps: list[Step]
    outputs: tuple[Value, ...]
    read: frozenset[int]  # the inputs that an output depends on


def flat_program(function: Callable[..., PyTree], *examples: PyTree) -> Program:
    """Returns the program of a function of `examples`, arrays of one environment, [...].

    The program is of a batch of them.
    """
    abstract = batched(examples)
    inputs, steps = range(len(jax.tree.leaves(abstract))), list[Step]()
    numbers = itertools.count(len(inputs))

    def add(equation: Any, *values: Any) -> list[Any]:
        """Adds one equation, opens it, or computes it; returns its outputs."""
        name, params = equation.primitive.name, equation.params
        if name in traces.CALLS:
            return traces.evaluate(traces.sub_jaxprs(equation)[0], add, np.asarray, *values)
        if not any(isinstance(value, int) for value in values):
            return _compute(equation, values)
        results = tuple(itertools.islice(numbers, len(equation.outvars)))
        types = tuple(atom.aval for atom in equation.invars)
        steps.append(Step(name, params, values, results, types, equation.outvars[0].aval))
        return list(results)

    closed = jax.make_jaxpr(function)(*abstract)
    outputs = tuple(traces.evaluate(closed, add, np.asarray, *inputs))
    kept, needed = _needed(steps, outputs)
    return Program(kept, outputs, frozenset(needed & set(inputs)))


def batched(examples: PyTree, batch: Any = BATCH) -> PyTree:
    """Returns the shapes of `examples` with a first axis of that size."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((batch, *x.shape), x.dtype), examples)


def sizes(shape: Sequence[int], unknown: int) -> list[int]:
    """Returns a shape with `unknown` for the sizes that depend on the batch."""
    return [unknown if size and size % BATCH == 0 else size for size in shape]


def _needed(steps: Sequence[Step], outputs: Sequence[Value]) -> tuple[list[Step], set[int]]:
    """Returns the steps that the outputs depend on, and the numbers of all that they read."""
    needed = {value for value in outputs if isinstance(value, int)}
    kept: list[Step] = []
    for step in reversed(steps):
        if needed & set(step.outputs):
            needed |= {value for value in step.inputs if isinstance(value, int)}
            kept.append(step)
    return kept[::-1], needed


def _compute(equation: Any, inputs: Sequence[Any]) -> list[np.ndarray]:
    """Computes an equation of constants; an axis of the batch has one row, to be broadcast."""
    shapes, given = ("shape", "new_sizes"), equation.params
    params = {k: tuple(sizes(v, 1)) if k in shapes else v for k, v in given.items()}
    if params.get("sharding", 0) is not None:
        params.pop("sharding", None)
    return [np.asarray(x) for x in traces.bind_equation(equation.replace(params=params), *inputs)]
