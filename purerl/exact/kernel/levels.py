"""In which level each statement of a block runs.

A statement comes after all that it reads. All are tried in the first level possible and in the last
one; then those that read or write much are moved to where the block needs less memory.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from purerl.exact.kernel.values import Value, home

WORTH_MOVING = 32  # numbers that a statement reads last, or writes
SWEEPS = 4


def levels_of(statements: Sequence[Any], at_end: set[Value]) -> list[list[Any]]:
    """Returns the levels of statements, which are in a possible order.

    Args:
      statements: have `reads()`, homes of values, and `writes`, values.
      at_end: homes of the values that are read after the last level.
    """
    orders = [_Order(statements, at_end, late) for late in (False, True)]
    for order in orders:
        for _ in range(SWEEPS):
            if not any([order.improve(number) for number in range(len(statements))]):
                break
    order = min(orders, key=lambda x: x.live.max())
    levels: list[list[Any]] = [[] for _ in range(order.end)]
    for statement, level in zip(statements, order.level, strict=True):
        levels[level].append(statement)
    return levels


class _Order:
    """The levels of statements while they are moved; a statement is told by its number."""

    def __init__(self, statements: Sequence[Any], at_end: set[Value], late: bool):
        made_by = {home(x): n for n, s in enumerate(statements) for x in s.writes}
        self.needs = [{made_by[x] for x in s.reads() if x in made_by} for s in statements]
        self.users: list[list[int]] = [[] for _ in statements]
        self.level: list[int] = []
        for number, needs in enumerate(self.needs):
            self.level.append(1 + max((self.level[n] for n in needs), default=-1))
            for n in needs:
                self.users[n].append(number)
        self.end = 1 + max(self.level, default=-1)
        self.sizes = [sum(x.size for x in s.writes) for s in statements]
        self.stays = [bool({home(x) for x in s.writes} & at_end) for s in statements]
        self.movable = [hasattr(s, "code") for s in statements]
        for number in reversed(range(len(statements))) if late else ():
            if self.movable[number]:
                self.level[number] = self._latest(number)
        self.live = np.zeros(self.end + 1)
        for number in range(len(statements)):
            self._count(self.live, number, 1)

    def improve(self, number: int) -> bool:
        """Moves a statement to the level where least memory is needed; tells if it was moved."""
        touched = [number, *self.needs[number]]
        old = self.level[number]
        first = 1 + max((self.level[n] for n in self.needs[number]), default=-1)
        last = self._latest(number)
        worth = self.movable[number] and max(self.sizes[n] for n in touched) >= WORTH_MOVING
        if first >= last or not worth:
            return False
        for n in touched:
            self._count(self.live, n, -1)
        costs = []
        for self.level[number] in range(first, last + 1):
            live = self.live.copy()
            for n in touched:
                self._count(live, n, 1)
            costs.append((live.max(), (live**4).sum()))
        best = min(range(len(costs)), key=lambda i: costs[i])
        self.level[number] = first + best
        for n in touched:
            self._count(self.live, n, 1)
        return self.level[number] != old

    def _latest(self, number: int) -> int:
        return min((self.level[n] - 1 for n in self.users[number]), default=self.end - 1)

    def _count(self, live: np.ndarray, number: int, sign: int) -> None:
        """Adds what a statement writes to what is live, from its level to its last reader's."""
        last = max((self.level[n] for n in self.users[number]), default=self.level[number])
        until = self.end if self.stays[number] else last
        live[self.level[number] : until + 1] += sign * self.sizes[number]
