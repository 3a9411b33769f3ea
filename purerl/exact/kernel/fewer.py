"""Which numbers of an operation are computed: each once, and those of a stack part by part."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from purerl.exact.kernel.values import Const, Map, Value, View
from purerl.exact.kernel.zeros import Zeros

# A map of at least so many numbers is computed once for all that are equal, if each is there so
# often: a box's edges, which MJX has for each pair of geoms.
MANY, OFTEN = 64, 3
# Which places of a map are computed, part by part, and of each number its part and place in it.
Parts = tuple[list[np.ndarray], np.ndarray, np.ndarray]


def stacked(args: Sequence[Value], apart: set[Value]) -> Parts | None:
    """Returns the parts of a stack of large maps, if there is one in `args`, and none is `apart`.

    An operation on the whole would have all of them stand in memory, to be read once. It is
    made part by part; what follows on that reads what stands.
    """
    for x in args:
        if isinstance(x, View) and len(x.sources) > 1:
            parts = [np.flatnonzero(x.which == number) for number in range(len(x.sources))]
            sizes = {len(np.unique(x.index[part])) for part in parts} | set(map(len, parts))
            sizes |= {y.size if isinstance(y, Map) else 0 for y in x.sources}
            if len(sizes) == 1 and len(parts[0]) >= MANY and not apart & {*x.sources}:
                order = np.argsort(np.concatenate(parts))
                return parts, *np.divmod(order, len(parts[0]))
    return None


def alike(args: Sequence[Value], zeros: Zeros) -> Parts | None:
    """Returns the numbers of a map that are no others as its one part; None if most are no others.

    Known zeros are left to the sums, which leave them out.
    """
    free = (isinstance(x, View) and not zeros.of(x).any() or isinstance(x, Const) for x in args)
    if args[0].size < MANY or not all(free):
        return None
    numbers = [x.which * (1 << 32) + x.index if isinstance(x, View) else _bits(x) for x in args]
    _, first, number = distinct(numbers)
    if OFTEN * len(first) > len(number):
        return None
    order = np.argsort(first)  # as they come: places that follow each other need no table
    return [first[order]], np.zeros_like(number), np.argsort(order)[number]


def _bits(x: Value) -> np.ndarray:
    assert isinstance(x, Const)
    return x.array.reshape(-1).view(f"u{x.array.itemsize}").astype(np.int64)  # -0 is not 0


def distinct(columns: Sequence[np.ndarray]) -> Any:
    """Returns distinct rows, where each is first, and which of them is at each place."""
    return np.unique(np.column_stack(columns), True, True, axis=0)


def without_views(
    sources: Sequence[Value], which: np.ndarray, index: np.ndarray
) -> tuple[list[Value], np.ndarray, np.ndarray]:
    """Returns a view's parts (see `View`) in terms of values that are no views, if any number."""
    flat: list[Value] = []
    numbers: dict[int, int] = {}  # of a value in `flat`, by its id
    new_which, new_index = np.empty_like(which), np.empty_like(index)

    def number_of(value: Value) -> int:
        if id(value) not in numbers:
            numbers[id(value)] = len(flat)
            flat.append(value)
        return numbers[id(value)]

    for number in np.unique(which):
        source, here = sources[number], which == number
        if not isinstance(source, View):
            new_which[here], new_index[here] = number_of(source), index[here]
            continue
        inner = source.which[index[here]]
        new_index[here] = source.index[index[here]]
        table = {i: number_of(source.sources[i]) for i in np.unique(inner)}
        new_which[here] = np.vectorize(table.__getitem__, otypes=[int])(inner)
    return flat, new_which, new_index
