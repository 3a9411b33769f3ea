"""A JAX function as a flat list of steps, with what is constant computed: to be written elsewhere.

Functions within functions are opened, steps that no output needs are left out. The first axis of
every input is the batch. It is traced with a size that nothing else has, and may have any other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import Literal

from purerl.core.records import PyTree

# What only calls another function; the parameter that holds it is one of _BODIES.
_CALLS = {
    "checkpoint", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call",
    "custom_vjp_call_jaxpr", "jit", "pjit", "remat", "remat2",
}  # fmt: skip
_BODIES = ("jaxpr", "call_jaxpr", "fun_jaxpr")

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
    closed = jax.make_jaxpr(function)(*abstract)
    inputs = range(len(jax.tree.leaves(abstract)))
    opened = _Opened(len(inputs))
    outputs = tuple(opened.open(closed.jaxpr, closed.consts, list(inputs)))
    steps, needed = _needed(opened.steps, outputs)
    return Program(steps, outputs, frozenset(needed & set(inputs)))


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


@dataclass
class _Opened:
    """Steps, as they are collected."""

    number: int  # of values so far
    steps: list[Step] = field(default_factory=list)

    def open(self, jaxpr: Any, constants: Sequence[Any], inputs: Sequence[Value]) -> list[Value]:
        """Adds the steps of a jaxpr called with `inputs`; returns its outputs."""
        known: dict[Any, Value] = dict(
            zip(jaxpr.constvars, map(np.asarray, constants), strict=True)
        )
        known |= dict(zip(jaxpr.invars, inputs, strict=True))

        def value(atom: Any) -> Value:
            if isinstance(atom, Literal):
                return np.asarray(atom.val, jax.typeof(atom.val).dtype)
            return known[atom]

        for equation in jaxpr.eqns:
            results = self.equation(equation, [value(atom) for atom in equation.invars])
            known |= dict(zip(equation.outvars, results, strict=True))
        return [value(atom) for atom in jaxpr.outvars]

    def equation(self, equation: Any, inputs: list[Value]) -> list[Value]:
        """Adds one equation, opens it, or computes it; returns its outputs."""
        name, params = equation.primitive.name, equation.params
        if name in _CALLS:
            body = next(params[body] for body in _BODIES if body in params)
            return self.open(getattr(body, "jaxpr", body), getattr(body, "consts", ()), inputs)
        if not any(isinstance(value, int) for value in inputs):
            return _compute(equation, inputs)
        results = tuple(range(self.number, self.number + len(equation.outvars)))
        self.number += len(results)
        types = tuple(atom.aval for atom in equation.invars)
        result = equation.outvars[0].aval
        self.steps.append(Step(name, params, tuple(inputs), results, types, result))
        return list(results)


def _compute(equation: Any, inputs: list[Any]) -> list[Value]:
    """Computes an equation of constants; an axis of the batch has one row, to be broadcast."""
    shapes = ("shape", "new_sizes")
    params = {k: tuple(sizes(v, 1)) if k in shapes else v for k, v in equation.params.items()}
    if params.get("sharding", 0) is not None:
        params.pop("sharding", None)
    results = equation.primitive.bind(*inputs, **params)
    return [np.asarray(x) for x in (results if equation.primitive.multiple_results else [results])]
