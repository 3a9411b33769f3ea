"""Makes values: each once, in the outermost place where it can be, and only what depends on inputs.

What follows from constants is computed here, by numpy. A product with a constant zero is zero: of a
state that is not finite, 0 * NaN would be NaN. MJX multiplies the world's Jacobian, all zeros, with
most things, and Jacobians by masks; a state with NaN keeps NaN in all that is not such a product.
"""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from purerl.exact.kernel import fewer, lanes, values
from purerl.exact.kernel.operations import computed
from purerl.exact.kernel.values import DTYPES, Const, Held, Map, Value, View, kind_of
from purerl.exact.kernel.zeros import Zeros

SMALL = 256  # numbers: what is larger is not kept beyond its block to be computed once
FEW_TERMS = 4  # a row of so few is written out, each term where it is needed
MOST_WRITTEN_OUT = 1 << 17
# Sums of so many terms, in all rows, are made without those that are known to be 0, if only one in
# so many is not. Of the rows that are made one fold, each has more than this share of the longest
# one's terms: with fewer zeros than before, it is not made without them again.
MANY_TERMS, MANY_ZEROS, SHORTEST = 4096, 2, 0.6
FEW = 4  # numbers: one of so few is chosen, one of more is read from memory
# A map is computed for what is chosen of it alone, if it has so many times as many numbers.
WIDE = 4
# What a fold of nothing gives.
NOTHING = {"add": 0, "mul": 1, "or": 0, "and": 1, "max": -np.inf, "min": np.inf}


class Builder:
    """The values of one kernel as they are made; `blocks` are those that are open."""

    def __init__(self) -> None:
        """Begins a kernel."""
        self.top = values.Block("top")
        self.blocks = [self.top]
        self.zeros = Zeros()
        self._constants: dict[Any, Const] = {}
        self._apart: set[Value] = set()  # what was made of a stack's parts: see `fewer.py`

    @contextlib.contextmanager
    def inside(self, role: str) -> Iterator[values.Block]:
        """Opens a block within the present one."""
        block = values.Block(role, len(self.blocks))
        self.blocks.append(block)
        yield block
        self.blocks.pop()

    def const(self, array: Any, dtype: Any = None) -> Const:
        """Returns a constant."""
        if not isinstance(getattr(array, "dtype", np.dtype(int)), np.dtype):
            kind_of(array.dtype)  # raises: no array of numpy has keys
        array = np.asarray(array, dtype)
        kind = "f" if array.dtype == np.float64 else kind_of(array.dtype)
        array = np.ascontiguousarray(array, DTYPES[kind]).reshape(array.shape)
        key = array.shape, kind, array.tobytes()
        if key not in self._constants:
            self._constants[key] = Const(array.shape, kind, self.top, array)
        return self._constants[key]

    def held(self, shape: Sequence[int], dtype: Any, home: Held | None = None) -> Held:
        """Returns what a step or the caller is going to put into memory."""
        return Held(tuple(shape), kind_of(dtype), self.blocks[-1], home)

    def step(self, step: values.Step) -> list[Held]:
        """Adds a step to the present block; returns what it writes."""
        self.blocks[-1].items.append(step)
        return step.writes

    def linear(self, op: str, *reads: Value, **which: bool) -> Value:
        """Returns the result of a linear system (see `Linear`), which is solved once."""
        key = op, tuple(map(id, reads)), tuple(which.items())
        for block in self.blocks:
            if key in block.known:
                return block.known[key]
        result = self.held(reads[-1].shape, np.float32)
        self.step(values.Linear(self.blocks[-1], list(reads), [result], op, **which))
        return self.blocks[-1].known.setdefault(key, result)

    def map(self, op: str, *args: Value, kind: str = "", param: Any = None) -> Value:
        """Returns an operation's result of values of one shape, or that can be broadcast.

        The result is of the first argument's kind, if no kind is said.
        """
        kind = kind or args[0].kind
        shape = np.broadcast_shapes(*(x.shape for x in args))
        if 0 in shape:
            return self.const(np.zeros(shape, DTYPES[kind]))
        spread = [x if x.shape == shape else self.spread(x, shape) for x in args]
        arrays = [x.array for x in spread if isinstance(x, Const)]
        if len(arrays) == len(args) and op != "lookup":
            with np.errstate(all="ignore"):
                return self.const(computed(op, kind, param, *arrays))
        simple = self._simplified(op, kind, spread)
        if simple is not None:
            return simple
        some = fewer.stacked(spread, self._apart) or fewer.alike(spread, self.zeros)
        if some:
            parts, which, index = some
            each = [[self.take(x, part) for x in spread] for part in parts]
            found = [self.map(op, *xs, kind=kind, param=param) for xs in each]
            self._apart |= set(found)
            return self.view(found, which.reshape(shape), index.reshape(shape))
        key = op, kind, tuple(map(id, spread)), param
        new = Map(shape, kind, self.top, op, spread, param)
        reads = [*spread, param] if isinstance(param, Value) else spread
        return self._once(key, new, reads)

    def standing(self, value: Value) -> Value:
        """Returns the value as one that can stand in memory by itself."""
        if not isinstance(value, View | Const):
            return value
        new = Map(value.shape, value.kind, self.top, "copy", [value])
        return self._once(("standing", id(value)), new, [value])

    def lookup(self, table: Value, index: Value) -> Value:
        """Returns the numbers of a table at places, which have to be within it."""
        if isinstance(index, Const):
            return self.take(table, index.array)
        if table.size > FEW:
            table = table if isinstance(table, Const) else self.standing(table)
            return self.map("lookup", index, kind=table.kind, param=table)
        rows = [self.spread(self.take(table, np.array(i)), index.shape) for i in range(table.size)]
        return self.select(index, *rows)

    def choose(self, value: Value, options: np.ndarray, which: Value, of: np.ndarray) -> Value:
        """Returns of each row of a value's places, `options`, that with a number: [rows].

        Row i's number is `which[of[i]]`, within the row. Maps are computed for these places alone,
        where that is less; what is the same in a row, or in several, is there once.
        """
        rows, first, inverse = fewer.distinct([of, options])
        if len(rows) < len(of):
            once = self.choose(value, options[first], which, of[first])
            return self.take(once, inverse.reshape(-1))
        if (options == options[:, :1]).all():
            return self.take(value, options[:, 0])
        key = "chosen", id(value), options.tobytes(), id(which), of.tobytes()
        if key not in self.blocks[-1].known:
            self.blocks[-1].known[key] = self._chosen(value, options, which, of)
        return self.blocks[-1].known[key]

    def _chosen(self, value: Value, options: np.ndarray, which: Value, of: np.ndarray) -> Value:
        if isinstance(value, View) and not np.ptp(value.which[options], 1).any():
            used, part = np.unique(value.which[options[:, 0]], return_inverse=True)
            rows = [np.flatnonzero(part == number) for number in range(len(used))]
            parts = [self.choose(value.sources[i], value.index[options[row]], which, of[row])
                     for i, row in zip(used, rows, strict=True)]  # fmt: skip
            index = np.argsort(np.argsort(part, kind="stable"))
            return self.view(parts, part, index - np.searchsorted(np.sort(part), part))
        wide = len(np.unique(options)) >= WIDE * len(of)
        if isinstance(value, Map) and value.op != "lookup" and wide:
            args = [self.choose(x, options, which, of) for x in value.args]
            return self.map(value.op, *args, kind=value.kind, param=value.param)
        line = (np.diff(options, 2) == 0).all()  # else a place in a table of the options
        at = options if line else np.arange(options.size).reshape(options.shape)
        start, step = (self.const(x.astype(np.int32)) for x in (at[:, 0], at[:, 1] - at[:, 0]))
        address = self.map("add", self.map("mul", self.take(which, of), step), start)
        table = self.const(options.astype(np.int32))
        return self.lookup(value, address if line else self.lookup(table, address))

    def select(self, which: Value, first: Value, *others: Value) -> Value:
        """Returns of several values the one with a number, at each place."""
        for number, other in enumerate(others, 1):
            chosen = self.map("ge", which, self.const(np.int32(number)), kind="b")
            first = self.map("select_n", chosen, first, other, kind=first.kind)
        return first

    def fold(self, op: str, arg: Value, shape: Sequence[int]) -> Value:
        """Returns rows [*shape, terms] with each row made one number, in the order of its terms."""
        shape, size = tuple(shape), int(np.prod(shape, dtype=int))
        terms = arg.size // size if size else 0
        if not terms:
            return self.const(np.full(shape, NOTHING[op], DTYPES[arg.kind]))
        if terms <= FEW_TERMS and arg.size <= MOST_WRITTEN_OUT or isinstance(arg, Const):
            rows = arg.places.reshape(-1, terms)
            found = self.pick(arg, rows[:, 0])
            for term in range(1, terms):
                found = self.map(op, found, self.pick(arg, rows[:, term]))
            return self.take(found, np.arange(size).reshape(shape))
        shared = lanes.are_shared(size, terms)
        new = values.Fold(shape, arg.kind, self.top, op, arg, terms, shared)
        if n := lanes.width_of(new):
            return self._lower_half(new, n)
        return self._packed(new) or self._once(("fold", op, id(arg), shape), new, [arg])

    def _lower_half(self, fold: values.Fold, n: int) -> Value:
        """Returns a symmetric square of sums, which a Hessian is, made of its lower half."""
        some, index = np.unique(lanes.lower_rows(n), return_inverse=True)
        arg = self.pick(fold.arg, fold.arg.places.reshape(-1, fold.terms)[some])
        shared = lanes.are_shared(some.size, fold.terms, n)
        new = values.Fold(some.shape, fold.kind, self.top, fold.op, arg, fold.terms, shared)
        packed = None if shared else self._packed(new)
        half = packed or self._once(("half", id(arg)), new, [arg])
        return self.take(half, index.reshape(fold.shape))

    def _packed(self, fold: values.Fold) -> Value | None:
        """Returns a fold without most known zeros, its like rows as one; None if they are few."""
        if fold.op != "add" or fold.arg.size < MANY_TERMS:
            return None
        zero = self.zeros.of(fold.arg).reshape(fold.size, fold.terms)
        counts = fold.terms - zero.sum(1)
        if MANY_ZEROS * counts.sum() > fold.arg.size:
            return None
        order, terms = np.argsort(zero, 1, kind="stable"), fold.arg.places.reshape(zero.shape)
        parts: list[Value] = [self.const(np.zeros(1, DTYPES[fold.kind]))]
        which, index = np.zeros(fold.size, int), np.zeros(fold.size, int)
        while (most := counts.max()) > 0:
            (some,) = np.nonzero(counts > SHORTEST * most)
            which[some], index[some] = len(parts), np.arange(len(some))
            places = terms[some[:, None], order[some, :most]]
            parts.append(self.fold("add", self.pick(fold.arg, places), (len(some),)))
            counts[some] = 0
        return self.view(parts, which.reshape(fold.shape), index.reshape(fold.shape))

    def take(self, value: Value, index: np.ndarray) -> Value:
        """Returns the numbers at places, in the shape of `index`."""
        return self.view([value], np.zeros(index.shape, np.int64), index)

    def spread(self, value: Value, shape: tuple[int, ...]) -> Value:
        """Returns a value broadcast to a shape."""
        return self.take(value, np.broadcast_to(value.places, shape))

    def pick(self, value: Value, index: np.ndarray) -> Value:
        """Returns numbers of a value, computed for these places alone."""
        if isinstance(value, Map) and value.op != "lookup":
            args = [self.take(x, index) for x in value.args]
            return self.map(value.op, *args, kind=value.kind, param=value.param)
        return self.take(value, index)

    def view(self, sources: Sequence[Value], which: np.ndarray, index: np.ndarray) -> Value:
        """Returns numbers of several values, in the shape of `index`: see `View`."""
        shape = index.shape
        flat, which, index = fewer.without_views(sources, which.reshape(-1), index.reshape(-1))
        if not index.size:
            return self.const(np.zeros(shape, DTYPES[sources[0].kind]))
        if all(isinstance(x, Const) for x in flat):
            array = np.empty(index.size, DTYPES[sources[0].kind])
            for number, source in enumerate(flat):
                array[which == number] = source.array.reshape(-1)[index[which == number]]
            return self.const(array.reshape(shape))
        whole = len(flat) == 1 and flat[0].size == index.size
        if whole and flat[0].shape == shape and (index == np.arange(index.size)).all():
            return flat[0]
        new = View(shape, sources[0].kind, self.top, flat, which, index)
        key = "view", shape, tuple(map(id, flat)), which.tobytes(), index.tobytes()
        return self._once(key, new, flat)

    def rows(self, function: Any, values: Sequence[Value], *args: Any) -> Value:
        """Returns what a function of numpy, as `concatenate`, makes of several values."""
        which = function([np.full(x.shape, i) for i, x in enumerate(values)], *args)
        return self.view(values, which, function([x.places for x in values], *args))

    def _once(self, key: Any, new: Value, reads: Sequence[Value]) -> Value:
        """Returns the value that is known by this key, or the new one, put in its block.

        That is the outermost block where all it reads is known: what does not change in a loop is
        computed before it. A branch keeps what it alone computes.
        """
        free = isinstance(new, View)
        for block in self.blocks if new.size <= SMALL or free else self.blocks[-1:]:
            if key in block.known:
                return block.known[key]
        depth = max((x.block.depth for x in reads), default=0)
        if new.size > SMALL and not free:
            depth = len(self.blocks) - 1
        while depth + 1 < len(self.blocks) and self.blocks[depth + 1].role == "branch":
            depth += 1
        new.block = self.blocks[depth]
        new.block.known[key] = new
        self.zeros.of(new)  # now, when those of all that it reads are known
        if not free:
            new.block.items.append(new)
        return new

    def _simplified(self, op: str, kind: str, args: Sequence[Value]) -> Value | None:
        """Returns a value that is known to be the result, if there is one."""
        x, y = args[0], args[1] if len(args) > 1 else args[0]
        if op in ("convert_element_type", "copy") and x.kind == kind:
            return x
        if op == "select_n":
            if args[1] is args[2]:
                return args[1]
            if isinstance(x, Const):
                which = x.array.reshape(-1).astype(np.int64)
                return self.view(args[1:], which, args[1].places)
        for one, other in ((x, y), (y, x)):
            if not isinstance(one, Const):
                continue
            if op == "mul" and one.is_all(0):
                return one
            known = {"mul": 1, "add": 0} | ({"and": True, "or": False} if kind == "b" else {})
            if op in known and one.is_all(known[op]):
                return other
            if kind == "b" and op in ("and", "or") and one.is_all(op == "or"):
                return one
        if op == "add" and kind == "f":
            zeros = [self.zeros.of(one) for one in (x, y)]
            if np.logical_or(*zeros).all():
                return self.view([x, y], zeros[0].astype(int).reshape(x.shape), x.places)
        same = {"sub": 0, "div": 1}
        return x if op in same and isinstance(y, Const) and y.is_all(same[op]) else None
