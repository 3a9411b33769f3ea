"""Integers and booleans of a trace that are known before it runs: they follow from constants.

MJX computes its indices from constants with JAX operations, tens of thousands of them in a large
model. Here numpy computes them, once: JAX would compile a small program for each shape.
"""

import contextlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from purerl.exact.traces import CALLS, bind_equation, evaluate, sub_jaxprs


def is_known(value: Any) -> bool:
    """Tells whether a value is an array of integers or booleans that is not being traced."""
    traced = isinstance(value, jax.core.Tracer)
    return not traced and hasattr(value, "dtype") and _is_integral(value.dtype)


def _is_integral(dtype: Any) -> bool:
    return jnp.issubdtype(dtype, jnp.integer) or dtype == jnp.bool_


def as_value(x: Any, dtype: Any) -> Any:
    """Returns a constant of a trace as it is, but a Python number as one of numpy, if integral."""
    return x if hasattr(x, "dtype") or not _is_integral(dtype) else np.asarray(x, dtype)[()]


def fold(eqn: core.JaxprEqn, *inputs: Any) -> list:
    """Returns the results of an equation that are known; of the others nothing that is."""
    integral = [_is_integral(v.aval.dtype) for v in eqn.outvars]
    if not eqn.effects and all(integral) and all(map(is_known, inputs)):
        return _compute(eqn, *map(np.asarray, inputs))
    if not eqn.effects and any(integral) and eqn.primitive.name in CALLS:
        # A call may return known indices among other things: a derivative's first half does.
        return evaluate(sub_jaxprs(eqn)[0], fold, as_value, *inputs)
    return [None] * len(integral)


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
        outputs = evaluate(sub_jaxprs(eqn)[0], _compute, np.asarray, *values)
    elif rule and all(_is_integral(v.dtype) for v in values):
        outputs = [rule(eqn.params, *values)]
    else:
        with jax.ensure_compile_time_eval(), on_cpu():
            outputs = bind_equation(eqn, *map(jax.device_put, values))
    return [np.asarray(x, v.aval.dtype) for x, v in zip(outputs, eqn.outvars, strict=True)]


# --- a rule for each primitive: (parameters, *inputs) -> output ---


def broadcast(p: dict, x: np.ndarray) -> np.ndarray:
    """Returns what the primitive `broadcast_in_dim` makes of an array."""
    new = [i for i in range(len(p["shape"])) if i not in p["broadcast_dimensions"]]
    return np.broadcast_to(np.expand_dims(x, new), p["shape"])


def sliced(p: dict, x: np.ndarray) -> np.ndarray:
    """Returns what the primitive `slice` takes of an array."""
    strides = p["strides"] or (1,) * x.ndim
    return x[tuple(map(slice, p["start_indices"], p["limit_indices"], strides))]


def _cumulative_sum(p: dict, x: np.ndarray) -> np.ndarray:
    if p["reverse"]:
        return np.flip(np.flip(x, p["axis"]).cumsum(p["axis"], x.dtype), p["axis"])
    return x.cumsum(p["axis"], x.dtype)


def remainder(p: dict, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns what the primitive `rem` makes of integers."""
    # As in XLA: the result has the sign of the dividend, and is x for y = 0.
    return np.where(y == 0, x, np.fmod(x, np.where(y == 0, 1, y)))


# Integer arithmetic wraps around in numpy as in XLA.
_ELEMENTWISE = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "neg": np.negative, "sign": np.sign,
    "max": np.maximum, "min": np.minimum, "lt": np.less, "le": np.less_equal, "gt": np.greater,
    "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal,
    "and": np.bitwise_and, "or": np.bitwise_or, "not": np.invert,
}  # fmt: skip
_RULES: dict[str, Callable[..., np.ndarray]] = {
    name: lambda p, *values, function=function: function(*values)
    for name, function in _ELEMENTWISE.items()
} | {
    "broadcast_in_dim": broadcast,
    "concatenate": lambda p, *xs: np.concatenate(xs, p["dimension"]),
    "convert_element_type": lambda p, x: x.astype(p["new_dtype"]),
    "cumsum": _cumulative_sum,
    "iota": lambda p: np.indices(p["shape"], p["dtype"])[p["dimension"]],
    "rem": remainder,
    "reshape": lambda p, x: x.reshape(p["new_sizes"]),
    "select_n": lambda p, which, *cases: np.choose(which.astype(np.int32), cases),
    "slice": sliced,
    "squeeze": lambda p, x: np.squeeze(x, p["dimensions"]),
    "transpose": lambda p, x: np.transpose(x, p["permutation"]),
}
