"""In which level each statement of a block runs.

A statement comes after all that it reads. Two orders are tried, each statement as early as it can
and as late as it can, and the one is taken in which the block needs less memory.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from purerl.exact.kernel.values import Value, home


def levels_of(statements: Sequence[Any], at_end: set[Value]) -> list[list[Any]]:
    """Returns the levels of statements, which are in a possible order.

    Args:
      statements: have `reads()`, homes of values, `writes`, values, and `waits`: whether they may
        be late.
      at_end: homes of the values that are read after the last level.
    """
    made_by = {home(x): number for number, s in enumerate(statements) for x in s.writes}
    needs = [{made_by[x] for x in s.reads() if x in made_by} for s in statements]
    early: list[int] = []
    for needed in needs:
        early.append(1 + max((early[number] for number in needed), default=-1))
    end = 1 + max(early, default=-1)
    late, last = list(early), [end] * len(statements)
    for number in reversed(range(len(statements))):
        if statements[number].waits:
            late[number] = last[number] - 1
        for one in needs[number]:
            last[one] = min(last[one], late[number])
    sizes = [sum(x.size for x in s.writes) for s in statements]
    stays = [any(home(x) in at_end for x in s.writes) for s in statements]
    level_of = min((early, late), key=lambda order: _memory(order, needs, sizes, stays))
    levels: list[list[Any]] = [[] for _ in range(end)]
    for statement, level in zip(statements, level_of, strict=True):
        levels[level].append(statement)
    return levels


def _memory(order: list[int], needs: list[set[int]], sizes: list[int], stays: list[bool]) -> float:
    """Returns how many numbers are needed at once, at most."""
    end = max(order, default=0) + 1
    until = [end if stay else level for stay, level in zip(stays, order, strict=True)]
    for number, needed in enumerate(needs):
        for one in needed:
            until[one] = max(until[one], order[number])
    live = np.zeros(end + 1)
    for size, first, last in zip(sizes, order, until, strict=True):
        live[first : last + 1] += size
    return float(live.max(initial=0))
