"""Rows of sums that the lanes of a warp share: which, of what terms, and when these are 0."""

from typing import NamedTuple

import numpy as np

from purerl.exact.kernel import lanes
from purerl.exact.kernel.lanes import LANES
from purerl.exact.kernel.statements import Statement


class Row(NamedTuple):
    """A sum that lanes share: one number of a statement, and which terms are added."""

    statement: Statement
    number: int
    terms: np.ndarray  # see `lanes.terms_of`
    factor: int | None  # see `common_factor`

    def place(self) -> tuple[int, int]:
        """Returns where the loop over its terms begins and ends."""
        line = len(self.terms) and (np.diff(self.terms) == 1).all()
        first = int(self.terms[0]) if line else 0
        return first, first + len(self.terms)


def shape(statement: Statement) -> tuple[str, int, str]:
    """Returns what rows have to be equal in to be summed in one loop."""
    return statement.fold, statement.terms, statement.writes[0].kind


def distinct_rows(statement: Statement) -> list[Row]:
    """Returns the rows to sum: of a symmetric square those of its lower half."""
    n = statement.width
    rows = [r * n + c for r in range(n) for c in range(r + 1)] or list(range(statement.size))
    assert statement.zero is not None
    terms = lanes.terms_of(statement.zero[rows])
    factor = common_factor(statement)
    return [Row(statement, *row, factor) for row in zip(rows, terms, strict=True)]


def common_factor(statement: Statement) -> int | None:
    """Returns which leaf multiplies all rows' terms alike, a truth if one does, or None.

    Where it is 0 a term of a sum is not looked at: of a Hessian's, those of constraints that do not
    act.
    """
    if statement.fold != "add" or statement.size == 1:
        return None
    code, factors, found = statement.code, [statement.code.result], []
    for number in factors:  # which grows
        if number < 0:
            leaf = code.leaves[~number]
            alike = all((x == x[:1]).all() for x in (leaf.which, leaf.at))
            found += [~number] if leaf.sources and alike else []
        elif code.lines[number].op in ("mul", "convert_element_type"):
            factors += code.lines[number].args
    return min(found, key=lambda i: code.leaves[i].kind, default=None)


def mirrored(statement: Statement, row: int) -> int:
    """Returns where the row's result stands a second time: of a symmetric square."""
    n = statement.width
    return row % n * n + row // n if n else row


def padded(number: int) -> int:
    """Returns how many results lanes sum: a power of 2, or a multiple of LANES; see `put`."""
    return 1 << (number - 1).bit_length() if number < LANES else -(-number // LANES) * LANES
