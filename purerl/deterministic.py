"""Rewrites a traced function so that its sums have a fixed order, on every device.

A scatter-add is atomic on a GPU: terms that meet at one address are added in whatever order they
arrive, so two runs differ in the last bits. MJX is full of them (children of a body, sparse mass
matrices, tendons), and nearly all have indices that are known while tracing. Here the trace itself
is rewritten: each scatter-add with constant indices becomes gathers added in the order of the
updates. Nothing of MJX or JAX is patched, so nothing can leak into other code, and a new MJX that
adds more scatter-adds is covered without being known here.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

from purerl.types import Array, PyTree

_SUMS = ("scatter-add", "scatter_add", "scatter-mul", "scatter_mul", "scatter-sub", "scatter_sub")
# Primitives that only call one jaxpr: their body can be run in place.
_CALLS = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr"}
_CALLS |= {"custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr", "checkpoint": "jaxpr"}
_CALLS |= {"remat2": "jaxpr", "remat": "jaxpr"}

_FEW_TERMS = 4

Known = Callable[[], np.ndarray] | None  # gives a value known while tracing


class ScatterSum(NamedTuple):
    """One scatter primitive whose result may depend on the order of its sums."""

    primitive: str
    shape: tuple[int, ...]  # of the operand
    source: str  # where in the source it was traced


def trace_deterministic(function: Callable, *example: PyTree) -> core.ClosedJaxpr:
    """Traces `function` with every scatter sum rewritten to a fixed order.

    Args:
      function: a pure function of pytrees of arrays.
      *example: arguments, or `jax.ShapeDtypeStruct`s, of the shapes to trace at.

    Returns:
      The rewritten trace, a function of the flat arguments (`jax.extend.core.jaxpr_as_fun`).

    Raises:
      RuntimeError: a scatter sum is left whose order is not fixed.
    """
    closed = _prune(jax.make_jaxpr(function)(*example))
    rewritten = functools.partial(
        _evaluate, closed.jaxpr, closed.consts, [None] * len(closed.jaxpr.invars)
    )
    result = _prune(jax.make_jaxpr(rewritten)(*closed.in_avals))
    left = list_scatter_sums(result)
    if left:
        raise RuntimeError(
            f"{len(left)} sums without a fixed order are left after rewriting, the first is "
            f"{left[0]}: this version of JAX traces them in a way that purerl.deterministic does "
            "not know. Use the versions in the constraints file, or extend that module."
        )
    return result


def list_scatter_sums(closed: core.ClosedJaxpr) -> list[ScatterSum]:
    """Lists the scatter sums of a trace whose order nothing fixes, at any depth.

    Integer sums are exact, and `unique_indices` promises that no two terms meet: neither counts.
    """
    found = []
    for eqn in closed.jaxpr.eqns:
        if _is_unordered(eqn):
            found.append(ScatterSum(eqn.primitive.name, eqn.invars[0].aval.shape, _source(eqn)))
        for sub in _sub_jaxprs(eqn):
            found += list_scatter_sums(sub)
    return found


def _is_unordered(eqn: core.JaxprEqn) -> bool:
    """Says whether the result of an equation may depend on an order that nothing fixes.

    Sums of integers do not: they are exact.
    """
    sums = eqn.primitive.name in _SUMS and not eqn.params["unique_indices"]
    return sums and jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.inexact)


def _source(eqn: core.JaxprEqn) -> str:
    """Returns the file and line that traced an equation, outside of JAX itself."""
    traceback = eqn.source_info.traceback
    frames = traceback.frames if traceback else []
    own = [f for f in frames if "/jax/_src/" not in f.file_name] or frames
    return f"{own[0].file_name}:{own[0].line_num}" if own else "an unknown line"


def _sub_jaxprs(eqn: core.JaxprEqn) -> list[core.ClosedJaxpr]:
    """Returns the traces inside one equation (loop bodies, branches, called functions)."""
    found = []
    for value in eqn.params.values():
        for item in value if isinstance(value, tuple | list) else (value,):
            if isinstance(item, core.ClosedJaxpr):
                found.append(item)
            elif isinstance(item, core.Jaxpr):
                found.append(core.ClosedJaxpr(item, ()))
    return found


def _has_scatter_sum(eqn: core.JaxprEqn) -> bool:
    return any(list_scatter_sums(sub) for sub in _sub_jaxprs(eqn))


def _prune(closed: core.ClosedJaxpr) -> core.ClosedJaxpr:
    """Drops equations whose results nobody uses (top level; XLA does the rest)."""
    live = {id(v) for v in closed.jaxpr.outvars}
    kept = []
    for eqn in reversed(closed.jaxpr.eqns):
        if eqn.effects or any(id(v) in live for v in eqn.outvars):
            kept.append(eqn)
            live |= {id(v) for v in eqn.invars}
    return core.ClosedJaxpr(closed.jaxpr.replace(eqns=kept[::-1]), closed.consts)


def _evaluate(
    jaxpr: core.Jaxpr, consts: list[Any], known_args: list[Known], *args: Array
) -> list[Array]:
    """Runs a trace with its scatter sums replaced; `known_args` are arguments known beforehand."""
    values: dict[core.Var, Any] = {}
    known: dict[core.Var, Known] = {}

    def read(atom):
        return atom.val if isinstance(atom, core.Literal) else values[atom]

    def read_known(atom):
        if isinstance(atom, core.Literal):
            return functools.partial(np.asarray, atom.val)
        return known.get(atom)

    for var, const in zip(jaxpr.constvars, consts, strict=True):
        values[var] = const
        known[var] = _known_const(const)
    for var, arg, known_arg in zip(jaxpr.invars, args, known_args, strict=True):
        values[var], known[var] = arg, known_arg
    for eqn in jaxpr.eqns:
        inputs, known_inputs = [read(v) for v in eqn.invars], [read_known(v) for v in eqn.invars]
        outputs, known_outputs = _apply(eqn, inputs, known_inputs)
        values.update(zip(eqn.outvars, outputs, strict=True))
        known.update(zip(eqn.outvars, known_outputs, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _known_const(const: Any) -> Known:
    """A constant of the trace is known unless it is itself being traced."""
    if isinstance(const, jax.core.Tracer) or not hasattr(const, "dtype"):
        return None
    # Only indices matter here: keys and floating-point tables need never be fetched.
    integral = np.issubdtype(const.dtype, np.integer) or const.dtype == np.bool_
    return functools.partial(np.asarray, const) if integral else None


def _apply(eqn: core.JaxprEqn, inputs: list, known: list[Known]) -> tuple[list, list[Known]]:
    """Runs one equation, through the replacement for its kind where it has one."""
    name = eqn.primitive.name
    unknown = [None] * len(eqn.outvars)
    if _is_unordered(eqn):
        return [_ordered_scatter(eqn, inputs, known)], unknown
    if not _has_scatter_sum(eqn):
        return _bind(eqn, inputs), _fold(eqn, known)
    if name in _CALLS:
        inner = eqn.params[_CALLS[name]]
        inner = inner if isinstance(inner, core.ClosedJaxpr) else core.ClosedJaxpr(inner, ())
        return _evaluate(inner.jaxpr, inner.consts, known, *inputs), unknown
    if name in _LOOPS:
        return list(_LOOPS[name](eqn.params, inputs, known)), unknown
    raise RuntimeError(
        f"A sum without a fixed order stands inside {name!r}, which cannot be rewritten."
    )


def _bind(eqn: core.JaxprEqn, inputs: list) -> list:
    """Runs one equation as it is."""
    params = eqn.primitive.get_bind_params(eqn.params)
    # jax before 0.10 returned the called functions apart.
    called, params = params if isinstance(params, tuple) else ((), params)
    with eqn.ctx.manager:
        outputs = eqn.primitive.bind(*called, *inputs, **params)
    return list(outputs) if eqn.primitive.multiple_results else [outputs]


def _fold(eqn: core.JaxprEqn, known: list[Known]) -> list[Known]:
    """Says how to compute the results of an equation of known integers, if ever asked."""
    unknown = [None] * len(eqn.outvars)
    if eqn.effects or any(k is None for k in known):
        return unknown

    @functools.cache
    def compute() -> list[np.ndarray]:
        with jax.ensure_compile_time_eval():
            return [np.asarray(v) for v in _bind(eqn, [jnp.asarray(k()) for k in known])]

    return [functools.partial(lambda i: compute()[i], i) for i in range(len(eqn.outvars))]


def _scan(params: dict, inputs: list, known: list[Known]) -> list:
    """`lax.scan` with a rewritten body."""
    body, (n, m) = params["jaxpr"], _scan_sizes(params)
    known_body = known[:n] + [None] * (len(inputs) - n)

    def step(carry, x):
        out = _evaluate(body.jaxpr, body.consts, known_body, *inputs[:n], *carry, *x)
        return out[:m], out[m:]

    carry, xs = list(inputs[n : n + m]), list(inputs[n + m :])
    carry, ys = lax.scan(
        step, carry, xs, params["length"], reverse=params["reverse"], unroll=params["unroll"]
    )
    return [*carry, *ys]


def _scan_sizes(params: dict) -> tuple[int, int]:
    """How many of a scan's inputs are constants, and how many the carry."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    consts, carry, _ = params["ft_in"].unpack()  # since jax 0.11
    return len(consts), len(carry)


def _while(params: dict, inputs: list, known: list[Known]) -> list:
    """`lax.while_loop` with a rewritten condition and body."""
    n, m = params["cond_nconsts"], params["body_nconsts"]
    test, body = params["cond_jaxpr"], params["body_jaxpr"]
    carry = list(inputs[n + m :])
    unknown = [None] * len(carry)

    def condition(c):
        return _evaluate(test.jaxpr, test.consts, known[:n] + unknown, *inputs[:n], *c)[0]

    def step(c):
        return _evaluate(
            body.jaxpr, body.consts, known[n : n + m] + unknown, *inputs[n : n + m], *c
        )

    return lax.while_loop(condition, step, carry)


def _cond(params: dict, inputs: list, known: list[Known]) -> list:
    """`lax.switch` with rewritten branches."""
    branches = [
        functools.partial(_evaluate, b.jaxpr, b.consts, known[1:]) for b in params["branches"]
    ]
    index = inputs[0].astype(jnp.int32) if hasattr(inputs[0], "astype") else inputs[0]
    return lax.switch(index, branches, *inputs[1:])


_LOOPS = {"scan": _scan, "while": _while, "cond": _cond}


def _ordered_scatter(eqn: core.JaxprEqn, inputs: list, known: list[Known]) -> Array:
    """A scatter-add as gathers added in the order of the updates.

    Raises:
      RuntimeError: the primitive is not a scatter-add, or its indices are not known.
    """
    operand, _, updates = inputs
    if known[1] is None or "add" not in eqn.primitive.name:
        raise RuntimeError(
            f"A {eqn.primitive.name} traced at {_source(eqn)} has indices that are known "
            "only while running, so its sum has no fixed order on a GPU. Ask for fewer readings, "
            "or change the model so that MJX does not need it."
        )
    order = _order_of_sums(_addresses(eqn, known[1]()), operand.size)
    total, flat = jnp.reshape(operand, (-1,)), jnp.reshape(updates, (-1,))
    if len(order) <= _FEW_TERMS:
        for turn in order:
            total = total + _terms(flat, turn)
    else:
        # One gather and one reduction: a long chain of sums takes XLA minutes to compile.
        total = total + jnp.sum(_terms(flat, np.stack(order)), axis=0)
    return jnp.reshape(total, operand.shape)


def _terms(flat: Array, update: np.ndarray) -> Array:
    """Takes the updates of the given numbers, 0 where there is none (-1)."""
    present = update >= 0
    terms = flat[np.maximum(update, 0)]
    return terms if present.all() else jnp.where(present, terms, 0)


def _addresses(eqn: core.JaxprEqn, indices: np.ndarray) -> np.ndarray:
    """Returns for each update the flat address it is added to; -1 where it is dropped.

    A gather over the addresses themselves, with the scatter's own dimension numbers: it is the
    exact transpose, so no rule about windows has to be repeated here.
    """
    operand, _, updates = (v.aval for v in eqn.invars)
    d = eqn.params["dimension_numbers"]
    absent = set(d.inserted_window_dims) | set(d.operand_batching_dims)
    window = iter(updates.shape[i] for i in d.update_window_dims)
    sizes = tuple(1 if i in absent else next(window) for i in range(len(operand.shape)))
    numbers = lax.GatherDimensionNumbers(
        offset_dims=d.update_window_dims,
        collapsed_slice_dims=d.inserted_window_dims,
        start_index_map=d.scatter_dims_to_operand_dims,
        operand_batching_dims=d.operand_batching_dims,
        start_indices_batching_dims=d.scatter_indices_batching_dims,
    )
    clip = eqn.params["mode"] == lax.GatherScatterMode.CLIP
    mode = "clip" if clip else "fill"
    with jax.ensure_compile_time_eval():
        table = jnp.arange(int(np.prod(operand.shape)), dtype=jnp.int32).reshape(operand.shape)
        found = lax.gather(table, jnp.asarray(indices), numbers, sizes, mode=mode, fill_value=-1)
        return np.asarray(found).reshape(-1)


def _order_of_sums(address: np.ndarray, size: int) -> list[np.ndarray]:
    """Splits the updates by turn: `result[k][a]` is the k-th update of address a, or -1."""
    turns = np.zeros(size, np.int32)
    order: list[np.ndarray] = []
    for update, target in enumerate(address):
        if target < 0:
            continue
        if turns[target] == len(order):
            order.append(np.full(size, -1, np.int32))
        order[turns[target]][target] = update
        turns[target] += 1
    return order
