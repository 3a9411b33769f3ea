"""Rewrites a traced function so that its sums have a fixed order, on every device.

A scatter-add is atomic on a GPU: terms that meet at one address are added in whatever order they
arrive, so two runs differ in the last bits. MJX is full of them (children of a body, sparse mass
matrices, tendons), and nearly all have indices that are known while tracing. Here the trace itself
is rewritten: each scatter-add with constant indices becomes gathers added in the order of the
updates, over the addresses that receive any. Nothing of MJX or JAX is patched, so nothing can leak
into other code, and a new MJX that adds more scatter-adds is covered without being known here.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

from purerl.folding import (
    CALLS,
    Known,
    bind_equation,
    called_jaxpr,
    fold,
    known_constant,
    known_literal,
)
from purerl.types import Array, PyTree

_SUMS = ("scatter-add", "scatter_add", "scatter-mul", "scatter_mul", "scatter-sub", "scatter_sub")
_FEW_TERMS = 4


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
    unknown = [None] * len(closed.jaxpr.invars)
    rewritten = functools.partial(_evaluate, closed, unknown, {})
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
    closed: core.ClosedJaxpr, known_args: list[Known], shared: dict, *args: Array
) -> list[Array]:
    """Runs a trace with its scatter sums replaced, and what is known computed beforehand.

    Args:
      closed: the trace.
      known_args: how to get the arguments that are known beforehand.
      shared: the constants of the whole program by content, so that each stands there once.
      *args: the arguments.
    """
    closed = _prune(closed)
    jaxpr, values, known = closed.jaxpr, {}, {}

    def read(atom):
        if isinstance(atom, core.Literal):
            return atom.val
        if atom not in values:
            value = known[atom]()
            content = (value.shape, value.dtype.str, value.tobytes())
            values[atom] = shared.setdefault(content, value)
        return values[atom]

    def read_known(atom):
        return known_literal(atom) if isinstance(atom, core.Literal) else known.get(atom)

    values.update(zip(jaxpr.constvars, closed.consts, strict=True))
    known.update(zip(jaxpr.constvars, map(known_constant, closed.consts), strict=True))
    values.update(zip(jaxpr.invars, args, strict=True))
    known.update(zip(jaxpr.invars, known_args, strict=True))
    for eqn in jaxpr.eqns:
        known_inputs = [read_known(v) for v in eqn.invars]
        folded = fold(eqn, known_inputs)
        if folded is not None:
            known.update(zip(eqn.outvars, folded, strict=True))
            continue
        outputs = _apply(eqn, [read(v) for v in eqn.invars], known_inputs, shared)
        values.update(zip(eqn.outvars, outputs, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _apply(eqn: core.JaxprEqn, inputs: list, known: list[Known], shared: dict) -> list:
    """Runs one equation, through the replacement for its kind where it has one."""
    name = eqn.primitive.name
    if _is_unordered(eqn):
        return [_ordered_scatter(eqn, inputs, known)]
    if not _has_scatter_sum(eqn):
        return bind_equation(eqn, inputs)
    if name in CALLS:
        return _evaluate(called_jaxpr(eqn), known, shared, *inputs)
    if name in _LOOPS:
        return list(_LOOPS[name](eqn.params, inputs, known, shared))
    raise RuntimeError(
        f"A sum without a fixed order stands inside {name!r}, which cannot be rewritten."
    )


def _scan(params: dict, inputs: list, known: list[Known], shared: dict) -> list:
    """`lax.scan` with a rewritten body."""
    body, (n, m) = params["jaxpr"], _scan_sizes(params)
    known_body = known[:n] + [None] * (len(inputs) - n)

    def step(carry, x):
        out = _evaluate(body, known_body, shared, *inputs[:n], *carry, *x)
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


def _while(params: dict, inputs: list, known: list[Known], shared: dict) -> list:
    """`lax.while_loop` with a rewritten condition and body."""
    n, m = params["cond_nconsts"], params["body_nconsts"]
    test, body = params["cond_jaxpr"], params["body_jaxpr"]
    carry = list(inputs[n + m :])
    unknown = [None] * len(carry)

    def condition(c):
        return _evaluate(test, known[:n] + unknown, shared, *inputs[:n], *c)[0]

    def step(c):
        return _evaluate(body, known[n : n + m] + unknown, shared, *inputs[n : n + m], *c)

    return lax.while_loop(condition, step, carry)


def _cond(params: dict, inputs: list, known: list[Known], shared: dict) -> list:
    """`lax.switch` with rewritten branches."""
    branches = [functools.partial(_evaluate, b, known[1:], shared) for b in params["branches"]]
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
    addresses = _addresses(eqn, np.asarray(known[1]()))
    touched, turns = _order_of_sums(addresses, updates.size)
    whole, flat = jnp.reshape(operand, (-1,)), jnp.reshape(updates, (-1,))
    if (turns == updates.size).any():
        flat = jnp.concatenate([flat, jnp.zeros(1, flat.dtype)])
    total = _take(whole, touched)
    if len(turns) <= _FEW_TERMS:
        for turn in turns:
            total = total + _take(flat, turn)
    else:
        # One gather and one reduction: a long chain of sums takes XLA minutes to compile.
        total = total + jnp.sum(_take(flat, turns), axis=0)
    place = np.arange(operand.size)
    place[touched] = operand.size + np.arange(len(touched))
    return jnp.reshape(_take(jnp.concatenate([whole, total]), place), operand.shape)


def _take(flat: Array, index: np.ndarray) -> Array:
    """`flat[index]` of constant indices within bounds, as one operation."""
    first = index.flat[0] if index.size else 0
    if index.ndim == 1 and (index == first + np.arange(index.size)).all():
        return lax.slice(flat, (first,), (first + index.size,))
    numbers = lax.GatherDimensionNumbers((), (0,), (0,))
    index = index.astype(np.int32)[..., None]
    return lax.gather(flat, index, numbers, (1,), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)


def _addresses(eqn: core.JaxprEqn, indices: np.ndarray) -> np.ndarray:
    """Returns for each update the flat address it is added to; -1 where it is dropped.

    By XLA's definition of a scatter: each index vector says where a window of updates starts, and
    a window that does not fit is dropped whole, or moved until it fits (mode CLIP).
    """
    shape, updates = eqn.invars[0].aval.shape, eqn.invars[2].aval
    d = eqn.params["dimension_numbers"]
    batch_axes = [i for i in range(len(updates.shape)) if i not in d.update_window_dims]
    batch = tuple(updates.shape[i] for i in batch_axes)
    absent = (*d.inserted_window_dims, *d.operand_batching_dims)
    axis_of = dict(
        zip([i for i in range(len(shape)) if i not in absent], d.update_window_dims, strict=True)
    )
    starts = np.zeros((len(shape), *batch), np.int64)
    for column, dim in enumerate(d.scatter_dims_to_operand_dims):
        starts[dim] = indices[..., column]
    for dim, axis in zip(d.operand_batching_dims, d.scatter_indices_batching_dims, strict=True):
        starts[dim] = np.indices(batch)[axis]
    sizes = [updates.shape[axis_of[i]] if i in axis_of else 1 for i in range(len(shape))]
    room = (np.array(shape) - sizes).reshape(-1, *[1] * len(batch)).astype(np.int64)
    if eqn.params["mode"] == lax.GatherScatterMode.CLIP:
        starts = np.clip(starts, 0, room)
    fits = ((starts >= 0) & (starts <= room)).all(0)
    address = np.zeros(updates.shape, np.int64)
    steps = np.cumprod([1, *shape[:0:-1]])[::-1] if shape else []
    spread = tuple(i for i in range(len(updates.shape)) if i not in batch_axes)
    for dim, step in enumerate(steps):
        address += step * np.expand_dims(starts[dim], spread)
        if dim in axis_of:
            along = [1] * len(updates.shape)
            along[axis_of[dim]] = sizes[dim]
            address += step * np.arange(sizes[dim]).reshape(along)
    return np.where(np.expand_dims(fits, spread), address, -1).reshape(-1)


def _order_of_sums(address: np.ndarray, none: int) -> tuple[np.ndarray, np.ndarray]:
    """Sorts updates by the address that they are added to.

    Args:
      address: [updates]; -1 where an update is dropped.
      none: what stands for no update.

    Returns:
      The addresses that receive any, [touched], ascending; and the number of the k-th update of
      each, [turns, touched].
    """
    kept = np.flatnonzero(address >= 0)
    order = kept[np.argsort(address[kept], kind="stable")]
    touched, start, count = np.unique(address[order], return_index=True, return_counts=True)
    turns = np.full((count.max(initial=0), len(touched)), none)
    turn = np.arange(len(order)) - np.repeat(start, count)
    turns[turn, np.repeat(np.arange(len(touched)), count)] = order
    return touched, turns
