"""Where each value stands in an environment's memory, which is as small as it can easily be made.

Memory of values that are never needed at once is shared. Shared memory of a GPU is what decides how
many environments a multiprocessor steps side by side.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from purerl.exact.kernel.schedule import Scheduler
from purerl.exact.kernel.statements import SLOTS, Plan, Statement, StepStatement
from purerl.exact.kernel.values import Held, Value, home

TRIES = 24


class _Span(NamedTuple):
    """Values side by side: how many numbers, and when they are needed."""

    values: list[Value]
    size: int
    first: int
    last: int


class _Clock:
    """Walks through a plan as it runs, and notes when each value is written first and read last.

    A loop needs what it reads of outside until it ends.
    """

    def __init__(self) -> None:
        self.now = 0
        self.first: dict[Value, int] = {}
        self.last: dict[Value, int] = {}
        self.groups: list[list[Value]] = []

    def read(self, values: set[Value]) -> None:
        self.last |= dict.fromkeys(values, self.now)

    def write(self, values: Sequence[Value]) -> None:
        values = [home(x) for x in values]
        self.groups.append(values)
        for value in values:
            self.first.setdefault(value, self.now)
            self.last[value] = self.now

    def run(self, plan: Plan) -> None:
        for level in plan.levels:
            self.now += 1
            for statement in level:
                if isinstance(statement, Statement):
                    self.read(statement.reads())
                    self.write(statement.writes)
            for statement in level:
                if isinstance(statement, StepStatement):
                    self._step(statement)
        self.now += 1
        for _, code in plan.copies:
            self.read(code.reads())
        if plan.test:
            self.read(plan.test.reads())

    def spans(self) -> list[_Span]:
        """Returns when each group of values is needed."""
        when = [(min(self.first[x] for x in g), max(self.last[x] for x in g)) for g in self.groups]
        sizes = [sum(x.size for x in group) for group in self.groups]
        return [_Span(g, n, *w) for g, n, w in zip(self.groups, sizes, when, strict=True)]

    def _step(self, statement: StepStatement) -> None:
        self.read(statement.reads())
        self.write(statement.writes)
        for plan in statement.plans:
            self.now += 1
            self.run(plan)
        self.now += 1
        for plan in statement.plans:
            self.read(plan.outside)
        self.read({*statement.writes, *statement.matrices})  # a solve may still read its matrix


def placed(scheduler: Scheduler, inputs: Sequence[Held]) -> tuple[dict[Value, int], int]:
    """Returns a place for each value, by its home, and the size of the memory [4 bytes].

    Outputs have none: they are copied to the caller's arrays.
    """
    clock = _Clock()
    for one in inputs:
        clock.write([one])
    clock.run(scheduler.plan)
    spans, slots = clock.spans(), len(scheduler.slots)
    least, orders = slots + _needed_at_once(spans), _orders(spans)
    size, places = _first_fit(spans, next(orders), slots)
    while size > least and (order := next(orders, None)) is not None:
        size, places = min((size, places), _first_fit(spans, order, slots), key=lambda x: x[0])
    address: dict[Value, int] = {SLOTS: 0}
    for span, place in zip(spans, places, strict=True):
        for value in span.values:
            address[value] = place
            place += value.size
    return address, max(size, 1)


def _needed_at_once(spans: Sequence[_Span]) -> int:
    """Returns how many numbers are needed at once, at most: no order needs less memory."""
    begins = {span.first for span in spans}  # it is most when one has just begun
    needed = (sum(x.size for x in spans if x.first <= now <= x.last) for now in begins)
    return max(needed, default=0)


def _orders(spans: Sequence[_Span]) -> Iterator[np.ndarray]:
    """Yields orders in which to place: large and long-lived first, each a bit otherwise."""
    sizes = np.array([span.size for span in spans], float)
    times = np.array([min(span.last, 10**5) - span.first + 1 for span in spans], float)
    rng = np.random.default_rng(0)
    for number in range(TRIES):
        noise = np.exp(0.3 * rng.normal(size=len(spans)) * (number > 2))
        yield np.argsort(-sizes * times ** (0.0, 0.5, 1.0)[number % 3] * noise, kind="stable")


def _first_fit(spans: Sequence[_Span], order: np.ndarray, start: int) -> tuple[int, list[int]]:
    """Returns the memory's size and a place for each span: the first free one, in this order."""
    places = [0] * len(spans)
    done: list[tuple[int, int, int, int]] = []  # by place: (from, to, first, last)
    for number in order:
        span = spans[number]
        at = start
        for begin, end, first, last in done:
            if last < span.first or first > span.last:
                continue
            if at + span.size <= begin:
                break
            at = max(at, end)
        places[number] = at
        done.append((at, at + span.size, span.first, span.last))
        done.sort()
    return max([start, *(end for _, end, _, _ in done)]), places
