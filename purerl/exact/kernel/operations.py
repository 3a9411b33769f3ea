"""The operations on single numbers: as C, as numpy, and what they cost.

One table, so that what is known before a kernel runs is computed as the kernel would.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from purerl.exact import constants
from purerl.exact.kernel.values import DTYPES


class Operation(NamedTuple):
    """What one operation is."""

    text: str | Callable[[str, Any], str]  # "({} + {})"; or made from (kind, parameter)
    compute: Callable[..., Any] | None = None  # by numpy; None: see `computed`
    cost: int = 1  # in additions, roughly


def _power(kind: str, exponent: int) -> str:
    """By multiplication: a square is the most frequent one."""
    times = "*".join(["{0}"] * abs(exponent)) or "1"
    return f"({times})" if exponent >= 0 else f"(1.0f/({times}))"


def _convert(kind: str, param: Any) -> str:
    return {"f": "((float)({}))", "i": "((int)({}))", "b": "({} != 0)"}[kind]


def _remainder(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.fmod(x, y) if x.dtype.kind == "f" else constants.remainder({}, x, y)


OPERATIONS = {
    "div": Operation("({} / {})", None, 8),
    "neg": Operation("(-{})", np.negative),
    "abs": Operation(lambda kind, _: "fabsf({})" if kind == "f" else "abs({})", np.abs),
    "max": Operation("most({}, {})", np.maximum),
    "min": Operation("least({}, {})", np.minimum),
    "sign": Operation("sign_of({})", np.sign),
    "square": Operation("({0}*{0})", np.square),
    "integer_pow": Operation(_power),
    "sqrt": Operation("sqrtf({})", np.sqrt, 8),
    "rsqrt": Operation("(1.0f/sqrtf({}))", lambda x: 1 / np.sqrt(x), 16),
    "logistic": Operation("(1.0f/(1.0f + expf(-{})))", lambda x: 1 / (1 + np.exp(-x)), 20),
    "atan2": Operation("atan2f({}, {})", np.arctan2, 40),
    "pow": Operation("powf({}, {})", np.power, 40),
    "rem": Operation("rest_of({}, {})", _remainder, 10),
    "round": Operation("rintf({})", np.round),
    "not": Operation(lambda kind, _: "(!{})" if kind == "b" else "(~{})", np.invert),
    "is_finite": Operation("is_finite({})", np.isfinite),
    "select_n": Operation("({0} ? {2} : {1})", lambda which, no, yes: np.where(which, yes, no)),
    "convert_element_type": Operation(_convert),
    "copy": Operation("{}"),
    "lookup": Operation("{}"),  # of a place in the memory of another value: written by `text.py`
}
_SIGNS = {"add": "+", "sub": "-", "mul": "*", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
_SIGNS |= {"eq": "==", "ne": "!=", "and": "&", "or": "|", "xor": "^"}
_OF_NUMPY = """add subtract multiply less less_equal greater greater_equal equal not_equal
bitwise_and bitwise_or bitwise_xor""".split()  # noqa: SIM905
for (_name, _sign), _numpy in zip(_SIGNS.items(), _OF_NUMPY, strict=True):
    OPERATIONS[_name] = Operation(f"({{}} {_sign} {{}})", getattr(np, _numpy))
# Functions of C's and numpy's own names, and others.
_SAME = "cbrt ceil cos cosh exp exp2 expm1 floor log log1p sin sinh tan tanh".split()  # noqa: SIM905
_OTHERS = {"asin": "arcsin", "acos": "arccos", "atan": "arctan"}
for _name, _numpy in (dict(zip(_SAME, _SAME, strict=True)) | _OTHERS).items():
    OPERATIONS[_name] = Operation(f"{_name}f({{}})", getattr(np, _numpy), 20)
_NEUTRAL = {"add": "0", "mul": "1", "or": "0"}


def neutral(op: str, kind: str) -> str:
    """Returns C for what a fold starts from."""
    if op in ("max", "min"):
        least, most = ("-INFINITY", "INFINITY") if kind == "f" else ("INT_MIN", "INT_MAX")
        return least if op == "max" else most
    return _NEUTRAL.get(op, "1" if kind == "b" else "-1")


def text_of(op: str, kind: str, param: Any, *args: str) -> str:
    """Returns C for an operation whose result is of a kind."""
    text = OPERATIONS[op].text
    return (text if isinstance(text, str) else text(kind, param)).format(*args)


def computed(op: str, kind: str, param: Any, *arrays: np.ndarray) -> np.ndarray:
    """Returns the result of an operation on arrays."""
    dtype = DTYPES[kind]
    if op == "convert_element_type":
        return (arrays[0] != 0) if kind == "b" else arrays[0].astype(dtype)
    if op == "integer_pow":
        return (arrays[0] ** param).astype(dtype)
    if op == "div":
        quotient = np.true_divide(*arrays)
        return (quotient if kind == "f" else np.trunc(quotient)).astype(dtype)
    compute = OPERATIONS[op].compute
    return np.asarray(arrays[0] if compute is None else compute(*arrays), dtype)
