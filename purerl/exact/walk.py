"""Runs a trace once more, with other operations in the place of some equations.

The walk itself knows no replacement: `order.py` and `fuse.py` have the rules. It goes into loops,
branches and called functions where a rule wants something inside, and it computes beforehand the
integers that a rule asks for (`constants.py`).
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.extend import core

from purerl.exact.constants import Known, fold, known_constant, known_literal
from purerl.exact.traces import (
    CALLS,
    CUSTOM_DERIVATIVES,
    bind_equation,
    called_jaxpr,
    sub_jaxprs,
    with_own_derivative,
)

Inside = Callable[..., list]  # (trace, known_args, *args) -> results: the same walk, further in


class Rule(NamedTuple):
    """Which equations are replaced, and by what."""

    wants: Callable[[core.JaxprEqn], bool]
    # (wanted equation, inputs, known inputs, inside) -> outputs; None: it is not replaced after all
    replace: Callable[[core.JaxprEqn, list, list[Known], Inside], list | None]


def rewrite_trace(closed: core.ClosedJaxpr, rules: Sequence[Rule]) -> core.ClosedJaxpr:
    """Returns a trace with equations replaced, each by the first rule that applies to it."""
    unknown = [None] * len(closed.jaxpr.invars)
    run = functools.partial(_run, tuple(rules), {}, closed, unknown)
    return _prune(jax.make_jaxpr(run)(*closed.in_avals))


def _prune(closed: core.ClosedJaxpr) -> core.ClosedJaxpr:
    """Drops equations whose results nobody uses (top level; XLA does the rest)."""
    live = {id(v) for v in closed.jaxpr.outvars}
    kept = []
    for eqn in reversed(closed.jaxpr.eqns):
        if eqn.effects or any(id(v) in live for v in eqn.outvars):
            kept.append(eqn)
            live |= {id(v) for v in eqn.invars}
    return core.ClosedJaxpr(closed.jaxpr.replace(eqns=kept[::-1]), closed.consts)


def _run(
    rules: tuple[Rule, ...],
    shared: dict,
    closed: core.ClosedJaxpr,
    known_args: Sequence[Known],
    *args: Array,
) -> list[Array]:
    """Runs a trace.

    Args:
      rules: what to replace.
      shared: the constants of the whole program by content, so that each stands there once.
      closed: the trace.
      known_args: for each argument, how to compute its value while tracing; None if unknown.
      *args: the arguments.
    """
    jaxpr = _prune(closed).jaxpr
    values: dict[Any, Any] = {}
    known: dict[Any, Known] = {}

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
    inside = functools.partial(_run, rules, shared)
    for eqn in jaxpr.eqns:
        known_inputs = [read_known(v) for v in eqn.invars]
        folded = fold(eqn, known_inputs)
        known.update(zip(eqn.outvars, folded, strict=True))
        if folded and None not in folded:
            continue
        outputs = _apply(rules, eqn, [read(v) for v in eqn.invars], known_inputs, inside)
        values.update(zip(eqn.outvars, outputs, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _is_wanted(rules: tuple[Rule, ...], eqn: core.JaxprEqn) -> bool:
    """Tells whether a rule wants an equation or one inside of it."""
    return any(rule.wants(eqn) for rule in rules) or any(
        _is_wanted(rules, inner) for sub in sub_jaxprs(eqn) for inner in sub.jaxpr.eqns
    )


def _apply(
    rules: tuple[Rule, ...], eqn: core.JaxprEqn, inputs: list, known: list[Known], inside: Inside
) -> list:
    """Runs one equation by the first rule that applies, or as it is with its inside rewritten."""
    name = eqn.primitive.name
    if not _is_wanted(rules, eqn):
        return bind_equation(eqn, *inputs)
    for rule in rules:
        outputs = rule.replace(eqn, inputs, known, inside) if rule.wants(eqn) else None
        if outputs is not None:
            return outputs
    if name in CUSTOM_DERIVATIVES:
        body = functools.partial(inside, called_jaxpr(eqn), known)
        return with_own_derivative(eqn, lambda *x: body(*x), inputs)
    if name in CALLS:
        return inside(called_jaxpr(eqn), known, *inputs)
    if name in _LOOPS:
        return _LOOPS[name](eqn.params, inputs, known, inside)
    return bind_equation(eqn, *inputs)


def scan(params: dict, inputs: list, known: list[Known], inside: Inside) -> list:
    """`lax.scan` with a rewritten body."""
    n, m = scan_sizes(params)
    known_body = known[:n] + [None] * (len(inputs) - n)

    def step(carry, x):
        out = inside(params["jaxpr"], known_body, *inputs[:n], *carry, *x)
        return out[:m], out[m:]

    carry, xs = list(inputs[n : n + m]), list(inputs[n + m :])
    carry, ys = lax.scan(
        step, carry, xs, params["length"], reverse=params["reverse"], unroll=params["unroll"]
    )
    return [*carry, *ys]


def scan_sizes(params: dict) -> tuple[int, int]:
    """Returns how many of a scan's inputs are constants, and how many the carry."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    consts, carry, _ = params["ft_in"].unpack()  # since jax 0.11
    return len(consts), len(carry)


def while_parts(
    params: dict, inputs: list, known: list[Known], inside: Inside
) -> tuple[Callable, Callable, list]:
    """Returns the rewritten condition and body of a `while`, and what it starts from."""
    n, m = params["cond_nconsts"], params["body_nconsts"]
    carry = list(inputs[n + m :])
    unknown = [None] * len(carry)

    def condition(c):
        return inside(params["cond_jaxpr"], known[:n] + unknown, *inputs[:n], *c)[0]

    def body(c):
        return inside(params["body_jaxpr"], known[n : n + m] + unknown, *inputs[n : n + m], *c)

    return condition, body, carry


def _while(params: dict, inputs: list, known: list[Known], inside: Inside) -> list:
    """`lax.while_loop` with a rewritten condition and body."""
    return lax.while_loop(*while_parts(params, inputs, known, inside))


def _cond(params: dict, inputs: list, known: list[Known], inside: Inside) -> list:
    """`lax.switch` with rewritten branches."""
    branches = [functools.partial(inside, b, known[1:]) for b in params["branches"]]
    index = inputs[0].astype(jnp.int32) if hasattr(inputs[0], "astype") else inputs[0]
    return lax.switch(index, branches, *inputs[1:])


_LOOPS = {"scan": scan, "while": _while, "cond": _cond}
