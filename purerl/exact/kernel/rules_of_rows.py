"""The rules of sums, products and orders, and of what else is made of rows of numbers."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.extend import core

from purerl.exact.kernel.builder import Builder
from purerl.exact.kernel.values import Value, kind_of

Rule = Callable[..., Any]


# --- sums, and what else makes few numbers of many ---


def _rows_of(x: Value, axes: Sequence[int]) -> tuple[np.ndarray, tuple[int, ...]]:
    """Returns places with `axes` last, and the shape without them."""
    kept = [axis for axis in range(len(x.shape)) if axis not in axes]
    return np.transpose(x.places, [*kept, *axes]), tuple(x.shape[axis] for axis in kept)


def _reduce(op: str) -> Rule:
    def rule(build: Builder, eqn: core.JaxprEqn, x: Value) -> Value:
        places, shape = _rows_of(x, eqn.params["axes"])
        return build.fold(op, build.take(x, places), shape)

    return rule


def _first_of(op: str) -> Rule:
    """The first of the greatest, or least; a NaN is before any number."""

    def rule(build: Builder, eqn: core.JaxprEqn, x: Value) -> Value:
        places, shape = _rows_of(x, eqn.params["axes"])
        rows = build.take(x, places)
        best = build.fold(op, rows, shape)
        best = build.take(best, np.broadcast_to(best.places[..., None], places.shape))
        equal = build.map("eq", rows, best, kind="b")
        if x.kind == "f":
            equal = build.map("or", equal, build.map("ne", rows, rows, kind="b"))
        number = np.broadcast_to(np.arange(places.shape[-1], dtype=np.int32), places.shape)
        beyond = build.const(np.full(places.shape, places.shape[-1], np.int32))
        numbers = build.map("select_n", equal, beyond, build.const(number), kind="i")
        return build.fold("min", numbers, shape)

    return rule


def _dot(build: Builder, eqn: core.JaxprEqn, x: Value, y: Value) -> Value:
    sums, batch = eqn.params["dimension_numbers"]
    sides = []
    for value, summed, batched in zip((x, y), sums, batch, strict=True):
        free = [i for i in range(len(value.shape)) if i not in (*summed, *batched)]
        places = np.transpose(value.places, [*batched, *free, *summed])
        parts = [[value.shape[i] for i in axes] for axes in (batched, free, summed)]
        sides.append(places.reshape([int(np.prod(part, dtype=int)) for part in parts]))
    left, right = sides[0][:, :, None, :], sides[1][:, None, :, :]
    full = np.broadcast_shapes(left.shape, right.shape)
    kind = kind_of(eqn.outvars[0].aval.dtype)
    terms = [build.map("convert_element_type", value, kind=kind) for value in (x, y)]
    terms = [build.take(v, np.broadcast_to(p, full))
             for v, p in zip(terms, (left, right), strict=True)]  # fmt: skip
    return build.fold("add", build.map("mul", *terms), eqn.outvars[0].aval.shape)


def _cumulative_sum(build: Builder, eqn: core.JaxprEqn, x: Value) -> Value:
    axis, backwards = eqn.params["axis"], eqn.params["reverse"]
    rows = list(np.moveaxis(x.places, axis, 0))
    found: list[Value] = []
    for row in rows[::-1] if backwards else rows:
        term = build.take(x, row)
        found.append(build.map("add", found[-1], term) if found else term)
    return build.rows(np.stack, found[::-1] if backwards else found, axis)


def _sort(build: Builder, eqn: core.JaxprEqn, *args: Value) -> list[Value]:
    """Each number's rank is how many come before it; the inverse of the ranks is the order."""
    axis, keys = eqn.params["dimension"], eqn.params["num_keys"]
    if not args[0].size:
        return list(args)
    order = _order(build, [_along(build, x, axis) for x in args[:keys]])
    rows, n = args[0].size // order.shape[-1], order.shape[-1]
    first = build.const((np.arange(rows, dtype=np.int32) * n)[:, None].repeat(n, 1))
    address = build.map("add", build.take(order, order.places.reshape(rows, n)), first)
    found = [build.lookup(_along(build, x, axis), address) for x in args]
    shape = np.moveaxis(args[0].places, axis, -1).shape
    back = np.moveaxis(np.arange(args[0].size).reshape(shape), -1, axis)
    return [build.take(x, back) for x in found]


def _along(build: Builder, x: Value, axis: int) -> Value:
    return build.take(x, np.moveaxis(x.places, axis, -1))


def _order(build: Builder, keys: Sequence[Value]) -> Value:
    """Returns which number is at each place of the sorted rows [..., n]: NaN last, and stable."""
    places = keys[0].places
    n = places.shape[-1]
    full = (*places.shape, n)
    one = np.broadcast_to(places[..., None], full)
    other = np.broadcast_to(places[..., None, :], full)
    number = np.arange(n)
    before: Value = build.const(np.broadcast_to(number[None, :] < number[:, None], full))
    for key in reversed(keys):
        x, y = build.take(key, one), build.take(key, other)
        less, equal = (build.map(op, y, x, kind="b") for op in ("lt", "eq"))
        if key.kind == "f":
            x_is, y_is = (build.map("ne", v, v, kind="b") for v in (x, y))
            less = build.map("or", less, build.map("and", x_is, build.map("not", y_is)))
            equal = build.map("or", equal, build.map("and", x_is, y_is))
        before = build.map("or", less, build.map("and", equal, before))
    rank = build.fold("add", build.map("convert_element_type", before, kind="i"), places.shape)
    here = build.take(rank, other)
    wanted = build.const(np.broadcast_to(number[:, None], full).astype(np.int32))
    mine = build.const(np.broadcast_to(number[None, :], full).astype(np.int32))
    equal = build.map("eq", here, wanted, kind="b")
    zero = build.const(np.zeros(full, np.int32))
    return build.fold("add", build.map("select_n", equal, zero, mine, kind="i"), places.shape)


RULES: dict[str, Rule] = {
    "argmax": _first_of("max"),
    "argmin": _first_of("min"),
    "cumsum": _cumulative_sum,
    "dot_general": _dot,
    "reduce_and": _reduce("and"),
    "reduce_max": _reduce("max"),
    "reduce_min": _reduce("min"),
    "reduce_or": _reduce("or"),
    "reduce_prod": _reduce("mul"),
    "reduce_sum": _reduce("add"),
    "sort": _sort,
}
