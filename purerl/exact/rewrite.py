"""Rewrites a traced function so that its sums have a fixed order, on every device.

A scatter-add is atomic on a GPU: terms that meet at one address are added in whatever order they
arrive, so two runs differ in the last bits. MJX is full of them (children of a body, sparse mass
matrices, tendons), and nearly all have indices that are known while tracing. Here the trace itself
is rewritten: each scatter-add with constant indices becomes gathers added in the order of the
updates, over the addresses that receive any. Nothing of MJX or JAX is patched, so nothing can leak
into other code, and a new MJX that adds more scatter-adds is covered without being known here.

A loop that counts up to a small constant (MJX's Newton iterations) becomes a scan that stands still
once it is done, with the same results: before each round of a `while` a GPU waits for the host,
which reads the condition, and programs for several devices wait for one another.

For a GPU, where a kernel takes microseconds however little it does, there are fewer of them: small
linear systems have one each (`small_systems.py`), line searches too (`loop_kernels.py`), what is
put at constant indices is gathered, and rounds of other innermost loops are written out. What
scans read of [n, 3] is handed to them as [3, n].
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend import core

from purerl.core.records import Array, PyTree
from purerl.exact import fused_loops, fused_solves
from purerl.exact.constants import (
    CALLS,
    Known,
    bind_equation,
    called_jaxpr,
    fold,
    known_constant,
    known_literal,
)
from purerl.exact.scatters import gathered_scatter, ordered_scatter, puts, source
from purerl.exact.traced_loops import (
    MOST_ROUNDS,
    WRITTEN_OUT,
    equations,
    is_tall,
    is_written_out,
    rounds,
    sub_jaxprs,
)

_SUMS = ("scatter-add", "scatter_add", "scatter-mul", "scatter_mul", "scatter-sub", "scatter_sub")


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
            f"{left[0]}: this version of JAX traces them in a way that purerl.exact.rewrite does "
            "not know. Use the versions in the constraints file, or extend that module."
        )
    return result


def list_scatter_sums(closed: core.ClosedJaxpr) -> list[ScatterSum]:
    """Lists the scatter sums of a trace whose order nothing fixes, at any depth.

    Integer sums are exact, and `unique_indices` promises that no two terms meet: neither counts.
    """
    return [
        ScatterSum(eqn.primitive.name, eqn.invars[0].aval.shape, source(eqn))
        for eqn in equations(closed)
        if _is_unordered(eqn)
    ]


def _is_unordered(eqn: core.JaxprEqn) -> bool:
    """Says whether the result of an equation may depend on an order that nothing fixes.

    Sums of integers do not: they are exact.
    """
    sums = eqn.primitive.name in _SUMS and not eqn.params["unique_indices"]
    return sums and jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.inexact)


def for_gpu() -> bool:
    """Tells whether what is traced will run on a GPU."""
    return jax.default_backend() == "gpu"


def _is_rewritten(eqn: core.JaxprEqn) -> bool:
    """Says whether there may be a replacement for an equation or for one inside of it."""
    return (
        _is_unordered(eqn)
        or fused_solves.wanted(eqn)
        or fused_loops.wanted(eqn)
        or (for_gpu() and (puts(eqn) or is_written_out(eqn)))
        or any(_is_rewritten(inner) for sub in sub_jaxprs(eqn) for inner in sub.jaxpr.eqns)
    )


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
        return [ordered_scatter(eqn, inputs, known)]
    if fused_solves.wanted(eqn):
        return fused_solves.compute(eqn, inputs)
    if fused_loops.wanted(eqn):
        return fused_loops.compute(eqn, inputs)
    if name != "while" and not _is_rewritten(eqn):
        return bind_equation(eqn, inputs)
    if puts(eqn) and known[1] is not None:
        return [gathered_scatter(eqn, inputs, known)]
    if name in CALLS:
        return _evaluate(called_jaxpr(eqn), known, shared, *inputs)
    if name in _LOOPS:
        params = eqn.params
        if for_gpu() and is_written_out(eqn):
            params = params | {"unroll": min(WRITTEN_OUT, params["length"])}
        return list(_LOOPS[name](params, inputs, known, shared))
    if not any(list_scatter_sums(sub) for sub in sub_jaxprs(eqn)):
        return bind_equation(eqn, inputs)
    raise RuntimeError(
        f"A sum without a fixed order stands inside {name!r}, which cannot be rewritten."
    )


def _scan(params: dict, inputs: list, known: list[Known], shared: dict) -> list:
    """`lax.scan` with a rewritten body."""
    body, (n, m) = params["jaxpr"], _scan_sizes(params)
    known_body = known[:n] + [None] * (len(inputs) - n)
    turned = [for_gpu() and is_tall(x) for x in inputs[:n]]

    def turn(consts):
        return [jnp.transpose(x) if tall else x for x, tall in zip(consts, turned, strict=True)]

    consts = turn(inputs[:n])

    def step(carry, x):
        out = _evaluate(body, known_body, shared, *turn(consts), *carry, *x)
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
    """`lax.while_loop` with a rewritten condition and body; a scan of few rounds at most."""
    n, m = params["cond_nconsts"], params["body_nconsts"]
    test, body = params["cond_jaxpr"], params["body_jaxpr"]
    carry = list(inputs[n + m :])
    unknown = [None] * len(carry)

    def condition(c):
        return _evaluate(test, known[:n] + unknown, shared, *inputs[:n], *c)[0]

    def step(c):
        return _evaluate(body, known[n : n + m] + unknown, shared, *inputs[n : n + m], *c)

    limit = rounds(params, known)
    if limit is None or limit > MOST_ROUNDS:
        return lax.while_loop(condition, step, carry)

    def step_unless_done(c, _):
        going = condition(c)
        return [jnp.where(going, new, old) for new, old in zip(step(c), c, strict=True)], None

    carry = [jnp.asarray(x, v.aval.dtype) for x, v in zip(carry, body.jaxpr.outvars, strict=True)]
    return lax.scan(step_unless_done, carry, None, limit)[0]


def _cond(params: dict, inputs: list, known: list[Known], shared: dict) -> list:
    """`lax.switch` with rewritten branches."""
    branches = [functools.partial(_evaluate, b, known[1:], shared) for b in params["branches"]]
    index = inputs[0].astype(jnp.int32) if hasattr(inputs[0], "astype") else inputs[0]
    return lax.switch(index, branches, *inputs[1:])


_LOOPS = {"scan": _scan, "while": _while, "cond": _cond}
