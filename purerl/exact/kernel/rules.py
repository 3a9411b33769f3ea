"""A rule for each primitive: what its results are in terms of values.

A rule is called with (builder, equation, *inputs) and returns the result, or a list of them. To
compute one primitive more, write its rule and add it to `RULES`, which stands at the end.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core

from purerl.exact import constants, scatters
from purerl.exact.kernel import rules_of_rows
from purerl.exact.kernel.builder import Builder
from purerl.exact.kernel.operations import OPERATIONS
from purerl.exact.kernel.values import DTYPES, Const, NoRuleError, Value, View, kind_of

Rule = Callable[..., Any]


def _elementwise(build: Builder, eqn: core.JaxprEqn, *args: Value) -> Value:
    kind = kind_of(eqn.outvars[0].aval.dtype)
    if eqn.primitive.name == "select_n" and len(args) > 3:
        return build.select(*args)
    return build.map(eqn.primitive.name, *args, kind=kind, param=eqn.params.get("y"))


# --- other places: views ---


def _place(function: Callable[[dict, np.ndarray], np.ndarray]) -> Rule:
    """Makes a rule of what numpy does with the places of a value."""
    return lambda build, eqn, x: build.take(x, function(eqn.params, x.places))


def _reshape(build: Builder, eqn: core.JaxprEqn, x: Value) -> Value:
    return build.take(x, x.places.reshape(eqn.outvars[0].aval.shape))


def _split(build: Builder, eqn: core.JaxprEqn, x: Value) -> list[Value]:
    ends = np.cumsum(eqn.params["sizes"])[:-1]
    return [build.take(x, part) for part in np.split(x.places, ends, eqn.params["axis"])]


def _unstack(build: Builder, eqn: core.JaxprEqn, x: Value) -> list[Value]:
    return [build.take(x, part) for part in np.moveaxis(x.places, eqn.params["axis"], 0)]


def _pad(build: Builder, eqn: core.JaxprEqn, x: Value, filler: Value) -> Value:
    places = x.places
    for axis, (low, high, between) in enumerate(eqn.params["padding_config"]):
        if between:
            raise NoRuleError("padding between numbers")
        kept = range(max(0, -low), places.shape[axis] - max(0, -high))
        places = np.take(places, kept, axis)
        width = [(0, 0)] * places.ndim
        width[axis] = max(0, low), max(0, high)
        places = np.pad(places, width, constant_values=-1)
    return build.view([x, filler], (places < 0).astype(int), np.maximum(places, 0))


# --- places that may be known only while running ---


def _number(build: Builder, number: int) -> Value:
    return build.const(np.int32(number))


def _address(build: Builder, starts: Sequence[Value], steps: Sequence[int]) -> Value:
    """Returns the sum of starts times steps."""
    found = build.const(np.zeros(starts[0].shape, np.int32)) if starts else _number(build, 0)
    for start, step in zip(starts, steps, strict=True):
        found = build.map("add", found, build.map("mul", start, _number(build, step)))
    return found


def _steps(shape: Sequence[int]) -> list[int]:
    """Returns how far apart neighbours along each axis are."""
    return [int(np.prod(shape[i + 1 :], dtype=int)) for i in range(len(shape))]


def _within(build: Builder, start: Value, room: int) -> Value:
    return build.map("min", build.map("max", start, _number(build, 0)), _number(build, room))


def _gather(build: Builder, eqn: core.JaxprEqn, x: Value, indices: Value) -> Value:
    """XLA's definition: each index vector says where a window of the operand starts."""
    p, shape = eqn.params, eqn.outvars[0].aval.shape
    d, sizes, steps = p["dimension_numbers"], p["slice_sizes"], _steps(x.shape)
    absent = {*d.collapsed_slice_dims, *d.operand_batching_dims}
    window = [axis for axis in range(len(x.shape)) if axis not in absent]
    batch_axes = [axis for axis in range(len(shape)) if axis not in d.offset_dims]
    place = np.indices(shape)
    inside = sum((place[o] * steps[w] for o, w in zip(d.offset_dims, window, strict=True)), 0)
    for dim, axis in zip(d.operand_batching_dims, d.start_indices_batching_dims, strict=True):
        inside = inside + place[batch_axes[axis]] * steps[dim]
    row = sum(place[a] * s for a, s in zip(batch_axes, _steps(indices.shape[:-1]), strict=True))
    width, room = indices.shape[-1], [x.shape[i] - sizes[i] for i in d.start_index_map]
    at = np.arange(indices.size).reshape(-1, width)
    asked = [build.take(indices, at[:, k]) for k in range(width)]
    starts = [_within(build, s, most) for s, most in zip(asked, room, strict=True)]
    row, inside = (np.broadcast_to(x, shape) for x in (row, inside))
    apart = [steps[i] for i in d.start_index_map]
    unknown = [i for i, start in enumerate(starts) if not isinstance(start, Const)]
    if len(unknown) == 1:
        i = unknown[0]
        known = [y.array[row] * step for y, step in zip(starts, apart, strict=True)
                 if isinstance(y, Const)]  # fmt: skip
        options = np.arange(room[i] + 1) * apart[i] + np.sum([inside, *known], 0)[..., None]
        found = build.choose(x, options.reshape(row.size, -1), starts[i], row.reshape(-1))
        found = build.take(found, found.places.reshape(shape))
    else:
        address = build.take(_address(build, starts, apart), row)
        found = build.lookup(x, build.map("add", address, build.const(inside.astype(np.int32))))
    if p["mode"] != jax.lax.GatherScatterMode.FILL_OR_DROP:
        return found
    fits: Value = build.const(np.ones(len(at), bool))
    for one, other in zip(asked, starts, strict=True):
        fits = build.map("and", fits, build.map("eq", one, other, kind="b"))
    nothing = {"f": np.nan, "i": np.iinfo(np.int32).min, "b": True}[x.kind]
    filler = nothing if p["fill_value"] is None else p["fill_value"]
    filler = build.spread(build.const(filler, DTYPES[x.kind]), shape)
    return build.map("select_n", build.take(fits, row), filler, found, kind=x.kind)


def _dynamic_slice(build: Builder, eqn: core.JaxprEqn, x: Value, *asked: Value) -> Value:
    sizes = eqn.params["slice_sizes"]
    starts = [_within(build, s, n - m) for s, n, m in zip(asked, x.shape, sizes, strict=True)]
    window = x.places[tuple(map(slice, sizes))].astype(np.int32)
    address = build.spread(_address(build, starts, _steps(x.shape)), window.shape)
    return build.lookup(x, build.map("add", address, build.const(window)))


def _scatter(build: Builder, eqn: core.JaxprEqn, x: Value, indices: Value, new: Value) -> Value:
    """Puts, adds or multiplies updates at constant places, each by itself or in their order."""
    if not isinstance(indices, Const):
        raise NoRuleError("places that are known only while running")
    op = eqn.primitive.name.removeprefix("scatter").lstrip("-")
    if eqn.params.get("update_jaxpr") is not None and not op:
        raise NoRuleError("a function of the numbers that stand there")
    addresses = scatters.addresses(eqn, indices.array)
    touched, turns = scatters.order_of_sums(addresses, new.size)
    for turn in turns:
        address, update = touched[turn < new.size], turn[turn < new.size]
        put = build.take(new, update)
        if op:
            put = build.map(op, build.take(x, address), put)
        which, place = np.zeros(x.size, int), np.arange(x.size)
        which[address], place[address] = 1, np.arange(len(address))
        x = build.view([x, put], which, place.reshape(x.shape))
    return x


# --- linear systems ---


def _cholesky(build: Builder, eqn: core.JaxprEqn, matrix: Value) -> Value:
    if len(matrix.shape) != 2:
        raise NoRuleError("a batch of matrices")
    return build.linear("cholesky", matrix)


def _solve(build: Builder, eqn: core.JaxprEqn, matrix: Value, sides: Value) -> Value:
    p = eqn.params
    if len(matrix.shape) != 2 or not p["left_side"] or p["unit_diagonal"]:
        raise NoRuleError("a batch, a system from the right, or one with ones on its diagonal")
    matrix, turned = _whole_matrix(build, matrix, p["lower"])
    which = {"lower": p["lower"] != turned, "transposed": bool(p["transpose_a"]) != turned}
    columns = [build.take(sides, places) for places in sides.places.T]
    return build.rows(np.stack, [build.linear("solve", matrix, x, **which) for x in columns], -1)


def _whole_matrix(build: Builder, matrix: Value, lower: bool) -> tuple[Value, bool]:
    """Returns a matrix that stands in memory, or its transpose, and tells if it is that.

    It has the half that is read. JAX puts zeros into the other half of a factor, and may transpose
    it; here the factor is read where it stands.
    """
    if isinstance(matrix, View):
        half = (np.tril if lower else np.triu)(np.ones(matrix.shape, bool))
        sources = {matrix.sources[i] for i in np.unique(matrix.which.reshape(half.shape)[half])}
        index, (source, *others) = matrix.index.reshape(half.shape), sources
        whole = not others and not isinstance(source, Const) and source.size == matrix.size
        for turned, places in ((False, matrix.places), (True, matrix.places.T)):
            if whole and (index == places)[half].all():
                return source, turned
    return build.standing(matrix), False


RULES: dict[str, Rule] = {
    **rules_of_rows.RULES,
    **dict.fromkeys(OPERATIONS.keys() - {"lookup"}, _elementwise),
    "add_any": lambda build, eqn, x, y: build.map("add", x, y),
    "broadcast_in_dim": _place(constants.broadcast),
    "cholesky": _cholesky,
    "clamp": lambda build, eqn, low, x, high: build.map("min", build.map("max", x, low), high),
    "concatenate": lambda build, eqn, *xs: build.rows(np.concatenate, xs, eqn.params["dimension"]),
    "dynamic_slice": _dynamic_slice,
    "gather": _gather,
    "optimization_barrier": lambda build, eqn, *xs: list(xs),
    "pad": _pad,
    **dict.fromkeys(("expand_dims", "reshape", "squeeze"), _reshape),
    "rev": _place(lambda p, places: np.flip(places, p["dimensions"])),
    **dict.fromkeys(("scatter", "scatter-add", "scatter-mul"), _scatter),
    "slice": _place(constants.sliced),
    "split": _split,
    "stack": lambda build, eqn, *xs: build.rows(np.stack, xs, eqn.params["axis"]),
    "tile": _place(lambda p, places: np.tile(places, p.get("reps", p.get("repeats")))),
    "transpose": _place(lambda p, places: np.transpose(places, p["permutation"])),
    "triangular_solve": _solve,
    "unstack": _unstack,
}  # fmt: skip
