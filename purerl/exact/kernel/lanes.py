"""Which sums the lanes of a warp share, and so the order of every sum.

The order follows from the model alone: it is the same for any number of environments, on any
device, and in the C++ of one lane.

- A row of terms that the lanes share: lane l adds terms l, l + 32, l + 64, ... in this order; then
  lanes l and l + 16 are added, l and l + 8, and so on down to l + 1.
- Any other row, from its first term to its last.
- Terms that are known to be 0 may be left out of a row (`Builder._packed`): what is left is a row.
  Where lanes share a row each leaves out its own (`terms_of`), and the sum is bit for bit the same.
"""

import math
from collections.abc import Iterator

import numpy as np

from purerl.exact.kernel.values import Fold, Map, Value, View

LANES = 32  # of a warp, which computes one environment
FEW_ROWS = 16  # of a fold whose rows the lanes share; of more rows each has a lane
WIDEST = 32  # a symmetric square, such as a Hessian, is shared too, if it has no more columns
# A row has the terms of a longer one, to read the same numbers, if it needs more than this share of
# the longer one's rounds.
SHORTEST = 0.6


def are_shared(rows: int, terms: int, n: int = 0) -> bool:
    """Tells whether the lanes share each of some rows; n: of a symmetric square [n, n]."""
    return terms >= LANES and (rows <= FEW_ROWS or 0 < n <= WIDEST)


def width_of(fold: Fold) -> int:
    """Returns n if the rows are an [n, n] of sums of products that is symmetric, else 0."""
    n = math.isqrt(fold.size)
    products = isinstance(fold.arg, Map) and fold.arg.op == "mul" and fold.op == "add"
    if not products or n * n != fold.size or n < 2:
        return 0
    factors = list(_factors(fold.arg, np.arange(fold.arg.size)))
    ids, index = (np.stack(parts, -1) for parts in zip(*factors, strict=True))
    _, number = np.unique(ids, return_inverse=True)
    factor = (number.reshape(ids.shape) * (1 << 32) + index).reshape(n, n, fold.terms, -1)
    return n if (np.sort(factor) == np.sort(factor.swapaxes(0, 1))).all() else 0


def lower_rows(n: int) -> np.ndarray:
    """Returns for each number of a symmetric [n, n] the place of its equal in the lower half."""
    row, column = np.divmod(np.arange(n * n), n)
    return np.maximum(row, column) * n + np.minimum(row, column)


def terms_of(zero: np.ndarray) -> list[np.ndarray]:
    """Returns which terms are added in each of the rows that lanes share: none in one of zeros.

    These are terms that follow each other, or entry i is one of lane i % 32's: it adds terms k with
    k % 32 = i % 32, as of a whole row, and then ones that are known to be 0.

    Args:
      zero: whether each term is known to be 0, [rows, terms].
    """
    found = [np.zeros(0, int)] * len(zero)
    alike: list[np.ndarray] = []  # which terms rows have in common, the shortest first
    for row in np.argsort(zero.sum(1), kind="stable"):
        needed = ~zero[row]
        enough = (some for some in alike if not (needed & ~some).any())
        best = next((x for x in enough if _rounds(needed) > SHORTEST * _rounds(x)), needed)
        if needed.any():
            found[row] = _by_lanes(best)
        if best is needed:
            alike.insert(0, needed)
    return found


def _rounds(needed: np.ndarray) -> int:
    """Returns how many terms the busiest lane adds."""
    return int(np.bincount(np.flatnonzero(needed) % LANES, minlength=1).max())


def _by_lanes(needed: np.ndarray) -> np.ndarray:
    places, rounds = np.flatnonzero(needed), _rounds(needed)
    line = np.arange(places[0], places[-1] + 1)
    if len(line) <= rounds * LANES:
        return line
    found = np.full((LANES, rounds), needed.argmin())
    for lane, row in enumerate(found):
        own = places[places % LANES == lane]
        row[: len(own)] = own
    return found.T.reshape(-1)


def _factors(value: Value, places: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields the factors of a product at places: of each number the value that has it, and where.

    A value is told by its id.
    """
    if isinstance(value, Map) and value.op == "mul":
        for arg in value.args:
            yield from _factors(arg, places)
    elif isinstance(value, View) and len(value.sources) == 1:
        yield from _factors(value.sources[0], value.index[places])
    elif isinstance(value, View):
        ids = np.array([id(source) for source in value.sources])
        yield ids[value.which[places]], value.index[places]
    else:
        yield np.full(places.shape, id(value)), places
