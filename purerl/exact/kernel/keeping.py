"""Which values stand in memory, and which are computed anew wherever they are read.

A map becomes a part of the statements that read it, if none of its numbers is computed twice then.
Another is kept, unless it is so cheap that reading it costs as much as computing it. Terms of a sum
that lanes share are computed in the sum's own loop: there they would only take memory and a
statement more. Of what is kept only those numbers stand in memory that anything reads, and of a
large value only those that are not known to be 0.
"""

import collections
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from purerl.exact.kernel import values
from purerl.exact.kernel.lanes import LANES
from purerl.exact.kernel.operations import OPERATIONS
from purerl.exact.kernel.values import Block, Fold, Map, Step, Value, View
from purerl.exact.kernel.zeros import Zeros

MOST_REPEATED = 16  # additions that may be made again, in all, because numbers are read repeatedly
# A value that is read a few times is computed anew if that costs about as much as reading it; a
# large one, which would take much memory, if it costs several times as much.
FEW_USES, CHEAP = 4, 1
LARGE, CHEAP_OF_LARGE = 400, 8
MUCH = 256  # known zeros of a value: then they are left out, and where the others stand is a table


def blocks_of(step: Step) -> list[Block]:
    """Returns the blocks inside a step, in the order in which they run."""
    if isinstance(step, values.Loop):
        return [block for block in (step.test, step.inner) if block]
    return step.branches if isinstance(step, values.Choice) else []


def copied_by(step: Step) -> list[Value]:
    """Returns which of the values that a step reads are copied to where it writes."""
    if isinstance(step, values.Loop):
        return step.reads
    return step.reads[-1:] if isinstance(step, values.Linear) else []


def results_inside(step: Step) -> Iterator[tuple[Value, Block]]:
    """Yields the values that a step copies at the end of a block inside of it."""
    if isinstance(step, values.Loop):
        yield from ((value, step.inner) for value in step.results)
    if isinstance(step, values.Choice):
        for block, results in zip(step.branches, step.results, strict=True):
            yield from ((value, block) for value in results)


def in_order(block: Block) -> Iterator[Any]:
    """Yields what a block computes at any depth, a step after what is inside of it."""
    for item in block.items:
        if isinstance(item, Step):
            for inner in blocks_of(item):
                yield from in_order(inner)
        yield item


class Site(NamedTuple):
    """Where numbers of a value are read: by which statement, and at which places."""

    root: Any  # what the statement computes
    block: Block
    places: np.ndarray
    by_lanes: bool = False  # [rows, terms], of which lanes share each row


class Uses:
    """Where values are read, which of their numbers, and in what way."""

    def __init__(self) -> None:
        """Begins with none."""
        # In a statement a number is computed once for each different `places`.
        self.sites: dict[Value, dict[Any, Site]] = collections.defaultdict(dict)
        self.read: dict[Value, np.ndarray] = {}  # whether anything reads each number, [size]
        self.as_they_stand: set[Value] = set()  # read by a step, or by a view of several values
        self.whole: set[Value] = set()  # read as a row that has all numbers
        self.keep: set[Value] = set()
        self.costs: dict[Value, int] = {}  # of computing one number of a value that is not kept

    def add(self, value: Value, site: Site, stands: bool = False) -> None:
        """Notes that a value is read; a view passes it on."""
        if isinstance(value, View):
            which, index = value.which[site.places], value.index[site.places]
            numbers = np.unique(which)
            for number in numbers:
                alone = len(numbers) == 1
                places, by_lanes = index if alone else index[which == number], site.by_lanes
                part = site._replace(places=places, by_lanes=by_lanes and alone)
                self.add(value.sources[number], part, stands or not alone)
        elif isinstance(value, Map | Fold):
            if stands:
                self.as_they_stand.add(value)
            self.read.setdefault(value, np.zeros(value.size, bool))[site.places] = True
            self.sites[value].setdefault((id(site.root), site.places.tobytes()), site)

    def elsewhere(self, value: Value) -> bool:
        """Tells whether a value is read as it stands, or in another block than its own."""
        here = all(site.block is value.block for site in self.sites[value].values())
        return not here or value in self.as_they_stand

    def only_by_lanes(self, value: Value) -> bool:
        """Tells whether a value is nothing but terms of sums that lanes share."""
        return value.size >= LANES and all(x.by_lanes for x in self.sites[value].values())

    def free(self, value: Value) -> bool:
        """Tells whether no number is computed twice if the value is not kept."""
        sites = self.sites[value].values()
        return len(sites) == 1 or sum(x.places.size for x in sites) <= self.read[value].sum()

    def often(self, value: Value) -> int:
        """Returns how often one statement computes the same number, at most."""
        sites = self.sites[value].values()
        return max(int(np.bincount(x.places.reshape(-1)).max(initial=0)) for x in sites)


def kept(top: Block, outputs: list[Value], zeros: Zeros) -> dict[Value, np.ndarray]:
    """Returns the maps and folds that stand in memory, and which of the numbers of each do.

    The others are never read, or are known to be 0.
    """
    items, repeated = list(in_order(top)), set[Value]()
    while True:
        uses = _uses(top, outputs, items, repeated, zeros)
        more = _not_repeated(uses, items)
        if not more:
            return {value: _places(value, uses, zeros) for value in uses.keep}
        repeated |= more


def _places(value: Value, uses: Uses, zeros: Zeros) -> np.ndarray:
    read = uses.read[value]
    others = read & ~zeros.of(value)
    much = value not in uses.whole and others.any() and value.size - others.sum() >= MUCH
    return np.flatnonzero(others if much else read)


def _uses(
    top: Block, outputs: list[Value], items: list[Any], repeated: set[Value], zeros: Zeros
) -> Uses:
    """Returns what is read where, if what is repeated and all that has to stand is kept."""
    uses = Uses()
    for value in outputs:
        uses.add(value, Site(value, top, value.places), stands=True)
    for item in reversed(items):
        if isinstance(item, Step):
            _add_step(uses, item)
        elif uses.sites[item]:
            if item in repeated or _is_kept(item, uses):
                uses.keep.add(item)
            _add_args(uses, item, _places(item, uses, zeros))
    return uses


def _not_repeated(uses: Uses, items: list[Any]) -> set[Value]:
    """Stops keeping what is cheap; returns what is not kept and would be computed too often."""
    found = set[Value]()
    for item in items:
        if isinstance(item, Map) and uses.sites[item]:
            cost = OPERATIONS[item.op].cost + sum(_cost(x, uses) for x in item.args)
            uses.costs[item] = cost
            often = uses.often(item)
            cheap = cost <= (CHEAP_OF_LARGE if item.size >= LARGE else CHEAP)
            if often > 1 and often * cost > MOST_REPEATED and not uses.only_by_lanes(item):
                found.add(item)
            elif cheap and len(uses.sites[item]) <= FEW_USES and not uses.elsewhere(item):
                uses.keep.discard(item)
    return found - uses.keep


def _add_step(uses: Uses, step: Step) -> None:
    """Notes what a step reads: only a system's matrix, and results, have to stand in memory."""
    for value in step.reads:
        matrix = isinstance(step, values.Linear) and value is not step.reads[-1]
        uses.whole |= {value} if matrix else set()
        uses.add(value, Site(value, step.block, value.places), stands=matrix)
    if isinstance(step, values.Loop) and step.test and step.going:
        uses.add(step.going, Site(step, step.test, step.going.places))
    for value, block in results_inside(step):
        uses.add(value, Site(value, block, value.places), stands=True)


def _add_args(uses: Uses, item: Map | Fold, places: np.ndarray) -> None:
    """Notes what computing a value's numbers at places reads, where they are computed."""
    sites = [Site(item, item.block, places)]
    if isinstance(item, Fold):
        terms = item.arg.places.reshape(-1, item.terms)[places]
        sites = [Site(item, item.block, terms, item.shared)]
    elif item not in uses.keep:
        sites = list(uses.sites[item].values())
    for site in sites:
        for arg in item.args if isinstance(item, Map) else [item.arg]:
            uses.add(arg, site)
    if isinstance(item, Map) and item.op == "lookup":
        table = item.param
        uses.whole.add(table)
        uses.add(table, Site(item, item.block, table.places.reshape(-1)), stands=True)


def _is_kept(item: Map | Fold, uses: Uses) -> bool:
    if isinstance(item, Fold) or uses.elsewhere(item):
        return True
    return not uses.free(item) and not uses.only_by_lanes(item)


def _cost(value: Value, uses: Uses) -> int:
    """Returns what computing one number anew costs."""
    if isinstance(value, View):
        return max(_cost(source, uses) for source in value.sources)
    return 0 if value in uses.keep else uses.costs.get(value, 0)
