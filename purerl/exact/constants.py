"""Values of a trace that are known before it runs: integers and booleans computed from constants.

MJX computes its indices from constants with JAX operations, tens of thousands of them in a large
model. Here numpy computes them, once: JAX would compile a small program for each shape.
"""

import contextlib
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from purerl.exact.traces import CALLS, bind_equation, called_jaxpr, evaluate

Known = Callable[[], np.ndarray] | None  # gives a value known while tracing


def known_constant(const: Any) -> Known:
    """Gives the value of a constant of a trace, unless that is itself being traced."""
    if isinstance(const, jax.core.Tracer) or not hasattr(const, "dtype"):
        return None
    # Only indices matter: keys and floating-point tables need not be fetched from the device.
    return functools.partial(np.asarray, const) if _is_integral(const.dtype) else None


def known_literal(literal: core.Literal) -> Known:
    """Gives the value of a literal."""
    return functools.partial(np.asarray, literal.val, literal.aval.dtype)


def fold(eqn: core.JaxprEqn, known: Sequence[Known]) -> list[Known]:
    """Says how to compute each result of an equation, if ever asked; None if it is not known."""
    integral = [_is_integral(v.aval.dtype) for v in eqn.outvars]
    unknown: list[Known] = [None] * len(integral)
    if eqn.effects or not any(integral):
        return unknown
    if None in known or not all(integral):
        # A call may return known indices among other things: a derivative's first half does.
        return _fold_trace(called_jaxpr(eqn), known) if eqn.primitive.name in CALLS else unknown

    @functools.cache
    def compute() -> list[np.ndarray]:
        return _compute(eqn, *(k() for k in known))

    return [functools.partial(lambda i: compute()[i], i) for i in range(len(eqn.outvars))]


def _fold_trace(closed: core.ClosedJaxpr, known_args: Sequence[Known]) -> list[Known]:
    """Says how to compute the results of a trace."""
    jaxpr = closed.jaxpr
    known = dict(zip(jaxpr.constvars, map(known_constant, closed.consts), strict=True))
    known |= dict(zip(jaxpr.invars, known_args, strict=True))

    def read(atom: Any) -> Known:
        return known_literal(atom) if isinstance(atom, core.Literal) else known[atom]

    for eqn in jaxpr.eqns:
        known |= dict(zip(eqn.outvars, fold(eqn, [read(v) for v in eqn.invars]), strict=True))
    return [read(v) for v in jaxpr.outvars]


def _is_integral(dtype: Any) -> bool:
    return jnp.issubdtype(dtype, jnp.integer) or dtype == jnp.bool_


def on_cpu() -> contextlib.AbstractContextManager:
    """Makes JAX compute on the CPU: a GPU's compiler takes long over each single operation."""
    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    except RuntimeError:  # JAX_PLATFORMS leaves the CPU out
        return contextlib.nullcontext()


def _compute(eqn: core.JaxprEqn, *values: np.ndarray) -> list[np.ndarray]:
    """Computes one equation of known inputs."""
    rule = _RULES.get(eqn.primitive.name)
    if eqn.primitive.name in CALLS:
        outputs = evaluate(called_jaxpr(eqn), _compute, np.asarray, *values)
    elif rule and all(_is_integral(v.dtype) for v in values):
        outputs = [rule(eqn.params, *values)]
    else:
        with jax.ensure_compile_time_eval(), on_cpu():
            outputs = bind_equation(eqn, *map(jax.device_put, values))
    return [np.asarray(x, v.aval.dtype) for x, v in zip(outputs, eqn.outvars, strict=True)]


def _broadcast(p: dict, x: np.ndarray) -> np.ndarray:
    shape = [1] * len(p["shape"])
    for size, place in zip(x.shape, p["broadcast_dimensions"], strict=True):
        shape[place] = size
    return np.broadcast_to(x.reshape(shape), p["shape"])


def _slice(p: dict, x: np.ndarray) -> np.ndarray:
    strides = p["strides"] or (1,) * x.ndim
    limits = zip(p["start_indices"], p["limit_indices"], strides, strict=True)
    return x[tuple(slice(*s) for s in limits)]


def _iota(p: dict) -> np.ndarray:
    shape = [1] * len(p["shape"])
    shape[p["dimension"]] = -1
    counted = np.arange(p["shape"][p["dimension"]], dtype=p["dtype"])
    return np.broadcast_to(counted.reshape(shape), p["shape"])


def _cumulative_sum(p: dict, x: np.ndarray) -> np.ndarray:
    if p["reverse"]:
        return np.flip(np.flip(x, p["axis"]).cumsum(p["axis"], x.dtype), p["axis"])
    return x.cumsum(p["axis"], x.dtype)


def _remainder(p: dict, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    # As in XLA: the result has the sign of the dividend, and is x for y = 0.
    return np.where(y == 0, x, np.fmod(x, np.where(y == 0, 1, y)))


def _select(p: dict, which: np.ndarray, *cases: np.ndarray) -> np.ndarray:
    return np.choose(which.astype(np.int32), cases)


# Integer arithmetic wraps around in numpy as in XLA.
_ELEMENTWISE = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "neg": np.negative, "sign": np.sign,
    "max": np.maximum, "min": np.minimum, "lt": np.less, "le": np.less_equal, "gt": np.greater,
    "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal,
    "and": np.bitwise_and, "or": np.bitwise_or, "not": np.invert,
}  # fmt: skip
_RULES: dict[str, Callable[..., np.ndarray]] = {
    name: functools.partial(lambda f, p, *values: f(*values), function)
    for name, function in _ELEMENTWISE.items()
}
_RULES |= {"broadcast_in_dim": _broadcast, "slice": _slice, "rem": _remainder, "select_n": _select}
_RULES |= {"iota": _iota, "cumsum": _cumulative_sum}
_RULES["reshape"] = lambda p, x: x.reshape(p["new_sizes"])
_RULES["convert_element_type"] = lambda p, x: x.astype(p["new_dtype"])
_RULES["squeeze"] = lambda p, x: np.squeeze(x, p["dimensions"])
_RULES["transpose"] = lambda p, x: np.transpose(x, p["permutation"])
_RULES["concatenate"] = lambda p, *xs: np.concatenate(xs, p["dimension"])
