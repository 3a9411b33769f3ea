"""Which values stand in memory, and which are computed anew wherever they are read.

A map that is read once becomes a part of what reads it. One that is read more often is kept, unless
it is so cheap that reading it costs as much as computing it. Terms of a sum that lanes share are
computed in the sum's own loop: there they would only take memory and a statement more.
"""

import collections
from collections.abc import Iterator
from typing import Any

import numpy as np

from purerl.exact.kernel import values
from purerl.exact.kernel.lanes import LANES
from purerl.exact.kernel.operations import OPERATIONS
from purerl.exact.kernel.values import Block, Fold, Map, Step, Value, View

MOST_REPEATED = 16  # additions that may be made again, in all, because numbers are read repeatedly
# A value that is read a few times is computed anew if that costs about as much as reading it; a
# large one, which would take much memory, if it costs several times as much.
FEW_USES, CHEAP = 4, 1
LARGE, CHEAP_OF_LARGE = 400, 8


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


class Uses:
    """How often values are read, where, and in what way."""

    def __init__(self) -> None:
        """Begins with none."""
        self.number: dict[Value, int] = collections.Counter()
        self.blocks: dict[Value, set[Block]] = collections.defaultdict(set)
        self.only_by_lanes: dict[Value, bool] = {}
        self.as_they_stand: set[Value] = set()  # read by a step, or by a view of several values
        self.keep: set[Value] = set()
        self.costs: dict[Value, int] = {}  # of computing one number of a value that is not kept

    def add(self, value: Value, block: Block, by_lanes: bool, stands: bool = False) -> None:
        """Notes that something in a block reads a value; a view passes it on."""
        several = isinstance(value, View) and len(value.sources) > 1
        if stands:
            self.as_they_stand.add(value)
        if isinstance(value, View):
            for source in value.sources:
                self.add(source, block, by_lanes and not several, stands or several)
            return
        self.number[value] += 1
        self.blocks[value].add(block)
        self.only_by_lanes[value] = by_lanes and self.only_by_lanes.get(value, True)


def kept(top: Block, outputs: list[Value]) -> set[Value]:
    """Returns the maps and folds that stand in memory."""
    uses = Uses()
    for value in outputs:
        uses.add(value, top, False, stands=True)
    items = list(in_order(top))
    for item in reversed(items):
        if isinstance(item, Step):
            _add_step(uses, item)
        elif uses.number[item] and _is_kept(item, uses):
            uses.keep.add(item)
        if isinstance(item, Map | Fold) and uses.number[item]:
            _add_args(uses, item)
    for item in items:
        if isinstance(item, Map | Fold) and uses.number[item]:
            _keep_what_repeats(item, uses)
        if isinstance(item, Map) and uses.number[item]:
            cost = OPERATIONS[item.op].cost + sum(_cost(x, uses) for x in item.args)
            uses.costs[item] = cost
            here = uses.blocks[item] == {item.block} and item not in uses.as_they_stand
            cheap = cost <= (CHEAP_OF_LARGE if item.size >= LARGE else CHEAP)
            if here and cheap and uses.number[item] <= FEW_USES:
                uses.keep.discard(item)
    return uses.keep


def _add_step(uses: Uses, step: Step) -> None:
    """Notes what a step reads: only a system's matrix, and results, have to stand in memory."""
    for value in step.reads:
        matrix = isinstance(step, values.Linear) and value is not step.reads[-1]
        uses.add(value, step.block, False, stands=matrix)
    if isinstance(step, values.Loop) and step.test and step.going:
        uses.add(step.going, step.test, False)
    for value, block in results_inside(step):
        uses.add(value, block, False, stands=True)


def _add_args(uses: Uses, item: Map | Fold) -> None:
    shared = isinstance(item, Fold) and item.shared
    by_lanes = shared or (item not in uses.keep and uses.only_by_lanes[item])
    for arg in item.args if isinstance(item, Map) else [item.arg]:
        uses.add(arg, item.block, by_lanes)
    if isinstance(item, Map) and item.op == "lookup":
        uses.add(item.param, item.block, False, stands=True)


def _is_kept(item: Map | Fold, uses: Uses) -> bool:
    elsewhere = uses.blocks[item] != {item.block}
    if isinstance(item, Fold) or elsewhere or item in uses.as_they_stand:
        return True
    terms = uses.only_by_lanes[item] and item.size >= LANES
    return uses.number[item] > 1 and not terms


def _keep_what_repeats(item: Map | Fold, uses: Uses) -> None:
    """Keeps arguments of which the same numbers would be computed too often."""
    for arg in item.args if isinstance(item, Map) else [item.arg]:
        if isinstance(arg, View) and len(arg.sources) == 1 and arg.size:
            (source,) = arg.sources
            often = int(np.bincount(arg.index).max())
            terms = uses.only_by_lanes.get(source, False)
            costly = often > 1 and often * _cost(source, uses) > MOST_REPEATED
            if isinstance(source, Map) and costly and not terms:
                uses.keep.add(source)


def _cost(value: Value, uses: Uses) -> int:
    """Returns what computing one number anew costs."""
    if isinstance(value, View):
        return max(_cost(source, uses) for source in value.sources)
    return 0 if value in uses.keep else uses.costs.get(value, 0)
