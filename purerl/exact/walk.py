"""Runs a trace once more, with other operations in the place of some equations.

The walk itself knows no replacement: `order.py` and `fuse.py` have the rules. It goes into loops,
branches and called functions where a rule wants something inside. Integers that follow from
constants are numpy arrays on the way, and not traced (`constants.py`), so a rule can read them.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core

from purerl.exact import traces
from purerl.exact.constants import as_value, fold, is_known

Inside = Callable[..., list]  # (trace, *args) -> results: the same walk, further in


class Rule(NamedTuple):
    """Which equations are replaced, and by what."""

    wants: Callable[[core.JaxprEqn], bool]
    # (wanted equation, inputs, inside) -> outputs; None: it is not replaced after all
    replace: Callable[[core.JaxprEqn, Sequence, Inside], list | None]


def rewrite_trace(closed: core.ClosedJaxpr, rules: Sequence[Rule]) -> core.ClosedJaxpr:
    """Returns a trace with equations replaced, each by the first rule that applies to it."""
    run = functools.partial(_run, tuple(rules), {}, closed)
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


def _run(rules: tuple[Rule, ...], shared: dict, closed: core.ClosedJaxpr, *args: Any) -> list:
    """Runs a trace; `shared` has known arrays by content, so that a program has each once."""
    inside = functools.partial(_run, rules, shared)

    def share(value: np.ndarray) -> Any:
        return shared.setdefault((value.shape, value.dtype.str, value.tobytes()), value[()])

    def apply(eqn: core.JaxprEqn, *inputs: Any) -> list:
        known = [share(np.asarray(x)) if is_known(x) else None for x in fold(eqn, *inputs)]
        if known and all(x is not None for x in known):
            return known
        found = _apply(rules, eqn, inputs, inside)
        return [y if x is None else x for x, y in zip(known, found, strict=True)]

    return traces.evaluate(_prune(closed), apply, as_value, *args)


def _is_wanted(rules: tuple[Rule, ...], eqn: core.JaxprEqn) -> bool:
    """Tells whether a rule wants an equation or one inside of it."""
    return any(rule.wants(eqn) for rule in rules) or any(
        _is_wanted(rules, inner) for sub in traces.sub_jaxprs(eqn) for inner in sub.jaxpr.eqns
    )


def _apply(
    rules: tuple[Rule, ...], eqn: core.JaxprEqn, inputs: Sequence, inside: Inside
) -> Sequence:
    """Runs one equation by the first rule that applies, or as it is with its inside rewritten."""
    name = eqn.primitive.name
    if not _is_wanted(rules, eqn):
        return traces.bind_equation(eqn, *inputs)
    for rule in rules:
        outputs = rule.replace(eqn, inputs, inside) if rule.wants(eqn) else None
        if outputs is not None:
            return outputs
    if name in traces.CUSTOM_DERIVATIVES:
        call = functools.partial(_call, eqn, inputs, inside)
        return traces.with_own_derivative(eqn, call, inputs)
    if name in traces.CALLS:
        return inside(traces.sub_jaxprs(eqn)[0], *inputs)
    if name in LOOPS:
        return LOOPS[name](eqn.params, inputs, inside)
    return traces.bind_equation(eqn, *inputs)


def _call(eqn: core.JaxprEqn, inputs: Sequence, inside: Inside, *traced: Array) -> list:
    """Calls a function on its inputs as they are traced now, but for those that are known."""
    args = [x if is_known(x) else y for x, y in zip(inputs, traced, strict=True)]
    return inside(traces.sub_jaxprs(eqn)[0], *args)


def scan(params: dict, inputs: Sequence, inside: Inside) -> list:
    """`lax.scan` with a rewritten body."""
    n, m = scan_sizes(params)

    def step(carry, x):
        out = inside(params["jaxpr"], *inputs[:n], *carry, *x)
        return out[:m], out[m:]

    how = {name: params[name] for name in ("length", "reverse", "unroll")}
    carry, ys = lax.scan(step, list(inputs[n : n + m]), list(inputs[n + m :]), **how)
    return [*carry, *ys]


def scan_sizes(params: dict) -> tuple[int, int]:
    """Returns how many of a scan's inputs are constants, and how many the carry."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    consts, carry, _ = params["ft_in"].unpack()  # since jax 0.11
    return len(consts), len(carry)


def while_parts(params: dict, inputs: Sequence, inside: Inside) -> tuple[Callable, Callable, list]:
    """Returns the rewritten condition and body of a `while`, and what it starts from."""
    n, m = params["cond_nconsts"], params["body_nconsts"]

    def condition(carry):
        return inside(params["cond_jaxpr"], *inputs[:n], *carry)[0]

    def body(carry):
        return inside(params["body_jaxpr"], *inputs[n : n + m], *carry)

    return condition, body, list(inputs[n + m :])


def _while(params: dict, inputs: Sequence, inside: Inside) -> list:
    """`lax.while_loop` with a rewritten condition and body.

    Of a vmapped loop the condition is not [], and a loop that is over waits for the others.
    """
    condition, body, start = while_parts(params, inputs, inside)
    if not params["cond_jaxpr"].out_avals[0].shape:
        return lax.while_loop(condition, body, start)

    def step(carry):
        going = condition(carry)
        pairs = zip(body(carry), carry, strict=True)
        axes = lambda x: tuple(range(going.ndim, x.ndim))  # noqa: E731
        return [jnp.where(jnp.expand_dims(going, axes(y)), x, y) for x, y in pairs]

    return lax.while_loop(lambda carry: condition(carry).any(), step, start)


def _cond(params: dict, inputs: Sequence, inside: Inside) -> list:
    """`lax.switch` with rewritten branches."""
    branches = [functools.partial(inside, b, *inputs[1:]) for b in params["branches"]]
    return lax.switch(jnp.asarray(inputs[0], jnp.int32), branches)


LOOPS = {"scan": scan, "while": _while, "cond": _cond}
