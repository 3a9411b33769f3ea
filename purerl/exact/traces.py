"""Reads traces: what is inside an equation, where it was written, and how it is run again."""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core

CUSTOM_DERIVATIVES = ("custom_jvp_call", "custom_vjp_call")
# Primitives that only call one trace: its equations can be run in place.
CALLS = ("jit", "closed_call", "core_call", "checkpoint", "remat", "remat2", *CUSTOM_DERIVATIVES)


def sub_jaxprs(eqn: core.JaxprEqn) -> list[core.ClosedJaxpr]:
    """Returns the traces inside one equation (loop bodies, branches, a called function)."""
    params = (x if isinstance(x, tuple | list) else (x,) for x in eqn.params.values())
    found = [x for some in params for x in some if isinstance(x, core.Jaxpr | core.ClosedJaxpr)]
    # They are one class since 0.11.
    return [x if isinstance(x, core.ClosedJaxpr) else core.ClosedJaxpr(x, ()) for x in found]


def equations(closed: core.ClosedJaxpr) -> Iterator[core.JaxprEqn]:
    """Yields all equations of a trace, at any depth, each before those inside of it."""
    for eqn in closed.jaxpr.eqns:
        yield eqn
        for sub in sub_jaxprs(eqn):
            yield from equations(sub)


def constants(closed: core.ClosedJaxpr) -> Iterator[Any]:
    """Yields the arrays and numbers that a trace holds, at any depth, some more than once."""
    yield from closed.consts
    for atom in (*(v for eqn in closed.jaxpr.eqns for v in eqn.invars), *closed.jaxpr.outvars):
        if isinstance(atom, core.Literal):
            yield np.asarray(atom.val, atom.aval.dtype)
    for sub in (sub for eqn in closed.jaxpr.eqns for sub in sub_jaxprs(eqn)):
        yield from constants(sub)


def read_in(closed: core.ClosedJaxpr) -> set[Any]:
    """Returns the variables that the equations of a trace read, and its results."""
    read = [*(v for eqn in closed.jaxpr.eqns for v in eqn.invars), *closed.jaxpr.outvars]
    return {x for x in read if isinstance(x, core.Var)}


def split(
    closed: core.ClosedJaxpr, wanted: Sequence[bool]
) -> tuple[core.ClosedJaxpr, core.ClosedJaxpr]:
    """Returns a trace as two: what its wanted results need, and the rest.

    The first one's results are those that it computes, in their order, and then what the second
    takes beside the arguments. The second one's are the others.
    """
    jaxpr = closed.jaxpr
    live = {x for x, want in zip(jaxpr.outvars, wanted, strict=True)
            if want and isinstance(x, core.Var)}  # fmt: skip
    early, late = list[core.JaxprEqn](), list[core.JaxprEqn]()
    for eqn in reversed(jaxpr.eqns):
        needed = bool(eqn.effects) or not live.isdisjoint(eqn.outvars)
        (early if needed else late).append(eqn)
        live |= {x for x in eqn.invars if needed and isinstance(x, core.Var)}
    made, put_off = ({v for eqn in some for v in eqn.outvars} for some in (early, late))

    def is_off(x: Any) -> bool:
        return isinstance(x, core.Var) and x in put_off

    taken = list(dict.fromkeys(x for eqn in late[::-1] for x in eqn.invars
                               if isinstance(x, core.Var) and x in made))  # fmt: skip
    first = [x for x in jaxpr.outvars if not is_off(x)] + taken
    second = [x for x in jaxpr.outvars if is_off(x)]
    parts = (jaxpr.invars, early, first), ([*jaxpr.invars, *taken], late, second)
    return tuple(
        core.ClosedJaxpr(
            jaxpr.replace(invars=reads, eqns=eqns[::-1], outvars=results), closed.consts
        )
        for reads, eqns, results in parts
    )  # type: ignore[return-value]


def has_loop(closed: core.ClosedJaxpr) -> bool:
    """Tells whether a trace has a loop at any depth.

    A scan whose rounds are all written out is none.
    """
    return any(
        eqn.primitive.name == "while"
        or (eqn.primitive.name == "scan" and eqn.params["unroll"] < eqn.params["length"])
        for eqn in equations(closed)
    )


def source(eqn: core.JaxprEqn) -> str:
    """Returns the file and line that traced an equation, outside of JAX itself."""
    traceback = eqn.source_info.traceback
    frames = traceback.frames if traceback else []
    own = [f for f in frames if "/jax/_src/" not in f.file_name] or frames
    return f"{own[0].file_name}:{own[0].line_num}" if own else "an unknown line"


def bind_equation(eqn: core.JaxprEqn, *inputs: Any) -> list:
    """Runs one equation as it is."""
    with eqn.ctx.manager:
        outputs = eqn.primitive.bind(*inputs, **eqn.primitive.get_bind_params(eqn.params))
    return list(outputs) if eqn.primitive.multiple_results else [outputs]


def with_own_derivative(eqn: core.JaxprEqn, compute: Callable, inputs: Sequence[Any]) -> list:
    """Returns `compute(*inputs)`, or the equation itself when that is being differentiated."""
    computed = jax.custom_jvp(compute)
    computed.defjvp(functools.partial(jax.jvp, functools.partial(bind_equation, eqn)))
    return computed(*inputs)


def evaluate(
    closed: core.ClosedJaxpr, apply: Callable[..., list], constant: Callable, *args: Any
) -> list:
    """Runs a trace on values of any kind.

    Args:
      closed: the trace.
      apply: (equation, *inputs) -> outputs.
      constant: (array, dtype) -> the value that stands for it.
      *args: the arguments.
    """
    values: dict[Any, Any] = {}

    def read(atom: Any) -> Any:
        literal = isinstance(atom, core.Literal)
        return constant(atom.val, atom.aval.dtype) if literal else values[atom]

    consts = [constant(x, jax.numpy.result_type(x)) for x in closed.consts]
    values.update(zip(closed.jaxpr.constvars, consts, strict=True))
    values.update(zip(closed.jaxpr.invars, args, strict=True))
    for eqn in closed.jaxpr.eqns:
        values.update(zip(eqn.outvars, apply(eqn, *map(read, eqn.invars)), strict=True))
    return [read(v) for v in closed.jaxpr.outvars]
