"""Statements: what a kernel does between two barriers, and how small ones are made one.

A statement computes all numbers of one kept value, or of several that are computed alike. Its text
is that of one number: a line for each operation, and a leaf for each number that it reads.
"""

import collections
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from purerl.exact.kernel import values
from purerl.exact.kernel.values import Held, Value, home

# Numbers of a statement that is made one with others of its kind. Larger ones are computed side by
# side as they are, and need no table of where each reads (lab/2026-11-29-one-kernel-on-a-gpu.md).
MERGED = 8
# What stands for the memory of single constants, which a view mixes with numbers of values.
SLOTS = Held((0,), "f", values.Block("top"))


class Leaf(NamedTuple):
    """A number that a statement reads: a constant's, or one of memory, for each place."""

    kind: str
    sources: tuple[Value, ...]  # homes, in memory; none: the numbers of `at` themselves
    which: np.ndarray
    at: np.ndarray


class Line(NamedTuple):
    """One operation of a statement's text; the arguments are numbers of lines, or ~ of leaves."""

    op: str
    kind: str
    param: Any
    args: tuple[int, ...]


@dataclass
class Code:
    """How one number is computed, at each of some places."""

    lines: list[Line] = field(default_factory=list)
    leaves: list[Leaf] = field(default_factory=list)
    result: int = 0
    tables: list[Value] = field(default_factory=list)  # what is looked up in

    def reads(self) -> set[Value]:
        """Returns what has to stand in memory, by its home."""
        found = {x for leaf in self.leaves for i, x in enumerate(leaf.sources)
                 if x is not SLOTS and (leaf.which == i).any()}  # fmt: skip
        return found | {home(x) for x in self.tables if not isinstance(x, values.Const)}


@dataclass
class Statement:
    """Computes `writes`, side by side in memory.

    A fold's code is that of one term, at places [rows, terms].
    """

    writes: list[Value]
    code: Code
    fold: str = ""  # the operation between terms
    terms: int = 1
    shared: bool = False  # whether the lanes share each row
    zero: np.ndarray | None = None  # of shared rows: which terms are known to be 0, [rows, terms]
    waits = True  # it may run as late as it can

    @property
    def size(self) -> int:
        """How many numbers it computes."""
        return sum(x.size for x in self.writes)

    def reads(self) -> set[Value]:
        """Returns what has to stand in memory before it, by its home."""
        return self.code.reads()


@dataclass
class StepStatement:
    """A step: what it copies to where it writes before it begins, and its inner blocks."""

    step: values.Step
    copies: list[tuple[Value, Code]]
    plans: list["Plan"]
    which: Code | None = None  # of a choice: the number of the branch
    matrices: Sequence[Value] = ()  # of a solve: where its matrix stands

    @property
    def waits(self) -> bool:
        """Tells whether it may run late: most of what follows needs what loops compute."""
        return isinstance(self.step, values.Linear)

    @property
    def writes(self) -> list[Value]:
        """The values that stand in memory after it."""
        return list(self.step.writes)

    def reads(self) -> set[Value]:
        """Returns what has to stand in memory before it, by its home."""
        found = read_by(self.copies).union(*(plan.outside for plan in self.plans))
        found |= set(self.matrices)
        return (found | (self.which.reads() if self.which else set())) - set(self.writes)


@dataclass
class Plan:
    """A block: its levels, then what is copied to the carry or to results, then what is tested."""

    levels: list[list[Statement | StepStatement]]
    copies: list[tuple[Value, Code]]
    test: Code | None  # of a loop: whether it goes on
    in_step: bool  # whether all environments run it equally often
    outside: set[Value] = field(default_factory=set)  # what it reads of other blocks, by its home

    def __post_init__(self) -> None:
        """Works out `outside`."""
        statements = [x for level in self.levels for x in level]
        written = {home(x) for statement in statements for x in statement.writes}
        read = read_by(self.copies).union(*(x.reads() for x in statements))
        self.outside = (read | (self.test.reads() if self.test else set())) - written


def read_by(copies: Sequence[tuple[Value, Code]]) -> set[Value]:
    """Returns what copies read, by its home."""
    return set().union(*(code.reads() for _, code in copies))


def needed_at_last(plan: Plan) -> list[Any]:
    """Returns what a loop's last round alone has to do: statements, and copies to a carry.

    No statement of a next round reads what comes of them.
    """
    every = [x for level in plan.levels for x in level]
    read = read_by(plan.copies).union(*(x.reads() for x in every))
    found: list[Any] = [copy for copy in plan.copies if copy[0] not in read]
    needed = read_by([copy for copy in plan.copies if copy[0] in read])
    for statement in reversed(every):
        if needed & {home(x) for x in statement.writes}:
            needed |= statement.reads()
        else:
            found.append(statement)
    return found


def merged(level: Sequence[Any]) -> list[Any]:
    """Returns a level's statements with small ones that compute alike made one."""
    groups: dict[Any, list[Any]] = collections.defaultdict(list)
    for statement in level:
        alone = isinstance(statement, StepStatement) or statement.shared
        alone = alone or statement.size > MERGED or bool(statement.code.tables)
        groups[id(statement) if alone else _form(statement)].append(statement)
    return [x[0] if len(x) == 1 else _one_of(x) for x in groups.values()]


def _form(statement: Statement) -> Any:
    """Returns what statements have to share to be made one."""
    code = statement.code
    kinds = tuple((leaf.kind, bool(leaf.sources)) for leaf in code.leaves)
    kind = statement.writes[0].kind
    return statement.fold, statement.terms, tuple(code.lines), kinds, code.result, kind


def _one_of(statements: Sequence[Statement]) -> Statement:
    leaves = []
    for parts in zip(*(x.code.leaves for x in statements), strict=True):
        firsts = np.cumsum([0, *(len(part.sources) for part in parts)])
        which = [part.which + first for part, first in zip(parts, firsts, strict=False)]
        sources = tuple(x for part in parts for x in part.sources)
        index = np.concatenate([part.at for part in parts])
        leaves.append(Leaf(parts[0].kind, sources, np.concatenate(which), index))
    first = statements[0]
    code = Code(first.code.lines, leaves, first.code.result)
    writes = [x for statement in statements for x in statement.writes]
    return Statement(writes, code, first.fold, first.terms)
