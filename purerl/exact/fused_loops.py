"""Loops over a few numbers and one long axis on a GPU, each as one kernel.

XLA makes four kernels of each round of MJX's line search, and each waits for the one before. Here
one warp makes all rounds of an environment and keeps all arrays in its registers. It computes the
trace of the loop's body, equation by equation. If there is no rule for an equation, the loop is
left to XLA (elliptic cones, equalities, friction in joints or tendons).

A value of the trace is an object array of the same rank. Its entries are numbers. If one of its
axes is the long one, that axis has size 1 here, and the entries are vectors along it, [m], where m
is the least power of 2 that is not below n.
"""

import functools
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core

from purerl.exact import constants, pallas_calls
from purerl.exact.traces import CALLS, equations, evaluate, sub_jaxprs

SHORT = 4  # entries of any other axis, at most
LONGEST = 512  # of the long one: 16 registers of each thread for a vector
Value = np.ndarray


class Long(NamedTuple):
    """The long axis in a kernel."""

    size: int  # n
    lane: Array  # [m] numbers of the entries
    inside: Array  # [m] bool: which of them there are


def wanted(eqn: core.JaxprEqn) -> bool:
    """Tells whether an equation is a loop to be computed by one kernel."""
    if eqn.primitive.name != "scan":
        return False
    body = eqn.params["jaxpr"]
    carries_all = [v.aval for v in body.jaxpr.outvars] == [v.aval for v in eqn.outvars]
    reads_all = [v.aval for v in body.jaxpr.invars] == [v.aval for v in eqn.invars]
    return carries_all and reads_all and _long_size(body) is not None


def _long_size(body: core.ClosedJaxpr) -> int | None:
    """Returns n; None if there is no long axis or more than one, or an equation without a rule."""
    traced = list(equations(body))
    inner = [sub for eqn in traced for sub in sub_jaxprs(eqn)]
    consts = [np.shape(const) for closed in (body, *inner) for const in closed.consts]
    atoms = [*body.jaxpr.invars, *(v for eqn in traced for v in (*eqn.invars, *eqn.outvars))]
    shapes = {v.aval.shape for v in atoms}
    if not all(map(_has_rule, traced)) or any(map(_is_long, consts)) or any(0 in s for s in shapes):
        return None
    match list({tuple(n for n in shape if n > SHORT) for shape in shapes} - {()}):
        case [(n,)] if n <= LONGEST:
            return n
    return None


def _is_long(shape: Sequence[int]) -> bool:
    return any(n > SHORT for n in shape)


def _has_rule(eqn: core.JaxprEqn) -> bool:
    name, values = eqn.primitive.name, [cast(Any, v.aval) for v in (*eqn.invars, *eqn.outvars)]
    if name == "dynamic_slice" and (values[0].ndim > 1 or eqn.params["slice_sizes"] != (1,)):
        return False
    if name == "select_n" and len(eqn.invars) > 3:  # Triton chooses between two
        return False
    known = name in _RULES and all(value.dtype in _DTYPES for value in values)
    return known and not (name in _OF_SHORT_AXES and any(_is_long(v.shape) for v in values))


def compute(eqn: core.JaxprEqn, platform: str, *inputs: Array) -> list[Array]:
    """Computes a loop that is `wanted`, by a kernel for a platform."""
    body = eqn.params["jaxpr"]
    size = _long_size(body)
    assert size is not None, "not wanted"
    kernel = functools.partial(_kernel, body, eqn.params["length"], size)
    results = [jax.ShapeDtypeStruct(a.shape, _kept(a.dtype)) for a in body.out_avals]
    given = [jnp.asarray(x, _kept(a.dtype)) for x, a in zip(inputs, body.in_avals, strict=True)]
    found = pallas_calls.call(kernel, results, *given, platform=platform)
    return [x.astype(a.dtype) for x, a in zip(found, body.out_avals, strict=True)]


def _kept(dtype: Any) -> Any:
    """Returns the type in which a kernel reads and writes: truth as whole numbers."""
    return jnp.int32 if dtype == jnp.bool_ else dtype


def _kernel(body: core.ClosedJaxpr, length: int, size: int, *references: Any) -> None:
    """Reads the inputs, makes all rounds, and writes the carry."""
    lane = lax.iota(jnp.int32, 1 << (size - 1).bit_length())
    long = Long(size, lane, lane < size)
    avals, number = body.in_avals, len(body.in_avals)
    values = [_load(long, ref, a) for ref, a in zip(references[:number], avals, strict=True)]
    consts = values[: number - len(body.out_avals)]
    carry = values[len(consts) :]
    shapes = [value.shape for value in carry]

    def step(i: Array, carry: list[list[Array]]) -> list[list[Array]]:
        new = _evaluate(long, body, *consts, *map(_value, shapes, carry))
        # A round may set what it carries to a constant: that becomes a vector, and no literal.
        return jax.tree.map(lambda a, b: jnp.where(i >= 0, a, b), _entries(new), carry)

    carry = list(map(_value, shapes, lax.fori_loop(0, length, step, _entries(carry))))
    for ref, value in zip(references[number:], carry, strict=True):
        _store(long, ref, value)


# --- values ---


def _value(shape: Sequence[int], entries: Iterable[Any]) -> Value:
    return np.fromiter(entries, object).reshape(tuple(shape))


def _entries(values: Iterable[Value]) -> list[list[Array]]:
    return [list(value.flat) for value in values]


def _short(shape: Sequence[int]) -> list[int]:
    """Returns the shape of the value that stands for an array."""
    return [1 if n > SHORT else n for n in shape]


def _places(long: Long, shape: Sequence[int]) -> list[tuple[Any, ...]]:
    """Returns where each entry of a value stands in an array."""
    return [
        tuple(long.lane if n > SHORT else i for n, i in zip(shape, place, strict=True))
        for place in np.ndindex(*_short(shape))
    ]


def _load(long: Long, ref: Any, aval: Any) -> Value:
    from jax.experimental.pallas import triton

    def entry(place: tuple[Any, ...]) -> Array:
        if _is_long(aval.shape):
            return triton.load(ref.at[place], mask=long.inside, other=0)
        return ref[place]

    entries = map(entry, _places(long, aval.shape))
    return _value(_short(aval.shape), (x != 0 if aval.dtype == jnp.bool_ else x for x in entries))


def _store(long: Long, ref: Any, value: Value) -> None:
    from jax.experimental.pallas import triton

    for place, entry in zip(_places(long, ref.shape), value.flat, strict=True):
        kept = entry.astype(ref.dtype)
        if _is_long(ref.shape):
            kept = jnp.broadcast_to(kept, long.lane.shape)
            triton.store(ref.at[place], kept, mask=long.inside)
        else:
            ref[place] = kept


def _evaluate(long: Long, closed: core.ClosedJaxpr, *args: Value) -> list[Value]:
    """Runs a trace."""

    def apply(eqn: core.JaxprEqn, *inputs: Value) -> list[Value]:
        return _RULES[eqn.primitive.name](long, eqn, *inputs)

    return evaluate(closed, apply, _constant, *args)


def _constant(x: Any, dtype: Any) -> Value:
    return _value(np.shape(x), [jnp.asarray(entry, dtype) for entry in np.asarray(x).flat])


def _map(function: Callable[..., Array], *args: Value) -> Value:
    """Calls `function` for the entries that stand at the same place."""
    spread = np.broadcast_arrays(*args)
    entries = zip(*(value.flat for value in spread), strict=True)
    return _value(spread[0].shape, (function(*entry) for entry in entries))


def _rows(value: Value, axis: int) -> list[Value]:
    rows = np.moveaxis(value, axis, 0)
    return [rows[i : i + 1].reshape(rows.shape[1:]) for i in range(len(rows))]


# --- a rule for each primitive: (long, equation, *inputs) -> outputs ---


def _elementwise(long: Long, eqn: core.JaxprEqn, *args: Value) -> list[Value]:
    def one(*entries: Array) -> Array:
        shape = np.broadcast_shapes(*map(jnp.shape, entries))  # a number beside vectors
        return eqn.primitive.bind(*(jnp.broadcast_to(x, shape) for x in entries), **eqn.params)

    return [_map(one, *args)]


def _sum(long: Long, eqn: core.JaxprEqn, value: Value) -> list[Value]:
    def along(x: Array) -> Array:
        return jnp.sum(jnp.where(long.inside, x, 0)) if x.ndim else x * long.size

    if any(eqn.invars[0].aval.shape[axis] > SHORT for axis in eqn.params["axes"]):
        value = _map(along, value)
    return _fold(operator.add, long, eqn, value)


def _fold(combine: Callable, long: Long, eqn: core.JaxprEqn, value: Value) -> list[Value]:
    for axis in sorted(eqn.params["axes"], reverse=True):
        value = functools.reduce(functools.partial(_map, combine), _rows(value, axis))
    return [value]


def _argmin(long: Long, eqn: core.JaxprEqn, value: Value) -> list[Value]:
    """The first of the least; a NaN is less than any number."""
    (axis,) = eqn.params["axes"]
    least, *others = _rows(value, axis)
    place = _map(lambda _: jnp.zeros((), eqn.params["index_dtype"]), least)
    for number, row in enumerate(others, 1):
        less = _map(lambda a, b: (a < b) | ((a != a) & (b == b)), row, least)
        least = _map(jnp.where, less, row, least)
        place = _map(jnp.where, less, _map(lambda p, i=number: jnp.full_like(p, i), place), place)
    return [place]


def _broadcast(long: Long, eqn: core.JaxprEqn, value: Value) -> list[Value]:
    spread = np.ones(len(eqn.params["shape"]), int)
    spread[list(eqn.params["broadcast_dimensions"])] = value.shape
    return [np.broadcast_to(value.reshape(tuple(spread)), _short(eqn.params["shape"]))]


def _dynamic_slice(long: Long, eqn: core.JaxprEqn, value: Value, start: Value) -> list[Value]:
    """One entry of [k], k short; an index beyond the ends is the end's."""
    found, *others = _rows(value, 0)
    for number, row in enumerate(others, 1):
        found = _map(lambda i, a, b, n=number: jnp.where(i >= n, a, b), start, row, found)
    return [found.reshape(1)]


def _cond(long: Long, eqn: core.JaxprEqn, index: Value, *args: Value) -> list[Value]:
    """All branches, then a choice."""
    found, *others = (_evaluate(long, branch, *args) for branch in eqn.params["branches"])
    for number, other in enumerate(others, 1):
        chosen = _map(lambda i, n=number: i.astype(jnp.int32) >= n, index)
        found = [_map(jnp.where, chosen, a, b) for a, b in zip(other, found, strict=True)]
    return found


# Not min and max, of which Triton's lose a NaN.
_NAMES = """abs add and convert_element_type div eq ge gt le lt mul ne not or select_n sqrt square
sub""".split()  # noqa: SIM905
_DTYPES = (jnp.float32, jnp.int32, jnp.bool_)
_RULES: dict[str, Callable[..., list[Value]]] = {
    **dict.fromkeys(_NAMES, _elementwise),
    "argmin": _argmin,
    "broadcast_in_dim": _broadcast,
    "cond": _cond,
    "dynamic_slice": _dynamic_slice,
    "reduce_or": functools.partial(_fold, operator.or_),
    "reduce_sum": _sum,
    "slice": lambda long, eqn, value: [constants.sliced(eqn.params, value)],
    "squeeze": lambda long, eqn, value: [value.reshape(eqn.outvars[0].aval.shape)],
    "stack": lambda long, eqn, *values: [np.stack(values, eqn.params["axis"])],
    **dict.fromkeys(CALLS, lambda long, eqn, *args: _evaluate(long, sub_jaxprs(eqn)[0], *args)),
}
_OF_SHORT_AXES = ("argmin", "dynamic_slice", "reduce_or", "slice", "squeeze", "stack")
