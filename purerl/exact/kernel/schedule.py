"""From values to statements, in levels: no statement of a level reads what another of it writes.

A statement computes all numbers of one kept value, or of several that are computed alike. Its text
is that of one number: a line for each operation, and a leaf for each number that it reads.
"""

import collections
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from purerl.exact.kernel import keeping
from purerl.exact.kernel.levels import levels_of
from purerl.exact.kernel.reading import Program
from purerl.exact.kernel.values import (
    Block,
    Choice,
    Const,
    Fold,
    Held,
    Linear,
    Loop,
    Map,
    Step,
    Value,
    View,
    home,
)

# Numbers of a statement that is made one with others of its kind. More of them, and where each
# reads is no longer said in a few instructions.
MERGED = 64
# What stands for the memory of single constants, which a view mixes with numbers of values.
SLOTS = Held((0,), "f", Block("top"))


class Leaf(NamedTuple):
    """A number that a statement reads: a constant's, or one of memory, for each place."""

    kind: str
    sources: tuple[Value, ...]  # homes, in memory; none: the numbers of `index` themselves
    which: np.ndarray
    index: np.ndarray


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
        return found | {home(x) for x in self.tables if not isinstance(x, Const)}


@dataclass
class Statement:
    """Computes `writes`, side by side in memory; a fold's code is that of one term [rows, terms]."""

    writes: list[Value]
    code: Code
    fold: str = ""  # the operation between terms
    terms: int = 1
    shared: bool = False  # whether the lanes share each row

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

    step: Step
    copies: list[tuple[Value, Code]]
    plans: list["Plan"]
    which: Code | None = None  # of a choice: the number of the branch

    @property
    def writes(self) -> list[Value]:
        """The values that stand in memory after it."""
        return list(self.step.writes)

    def reads(self) -> set[Value]:
        """Returns what has to stand in memory before it, by its home."""
        found = read_by(self.copies).union(*(plan.outside for plan in self.plans))
        if isinstance(self.step, Linear):
            found |= {home(x) for x in self.step.reads[:-1]}
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
    return set().union(*(code.reads() for _, code in copies))


class Scheduler:
    """Writes the statements of one program: `plan`, the homes of its `outputs`, and `slots`."""

    def __init__(self, program: Program):
        """Decides what is kept, and plans all blocks."""
        # Single constants that stand in memory, each by its bits.
        self.slots: dict[int, int] = {}
        self.keep = keeping.kept(program.block, program.outputs)
        self.outputs = [Held(x.shape, x.kind, program.block) for x in program.outputs]
        self.plan = self._plan(program.block, program.outputs, self.outputs)

    def code(self, value: Value, places: np.ndarray) -> Code:
        """Returns the code of a value's numbers at places, [...]."""
        code = Code()
        code.result = _Expression(self, code).add(value, places)
        return code

    def _plan(
        self,
        block: Block,
        results: Sequence[Value] = (),
        into: Sequence[Held] = (),
        test: Value | None = None,
        in_step: bool = True,
    ) -> Plan:
        statements: list[Any] = []
        for item in block.items:
            if isinstance(item, Step):
                statements.append(self._step(item, in_step))
            elif item in self.keep:
                statements.append(self._statement(item))
        copies, homes = [], {home(x) for x in into}
        for value, target in zip(results, into, strict=True):
            if home(value) is home(target) or not value.size:
                continue
            code = self._copy(value)
            if code.reads() & homes:
                # Copies are made one after another: what reads the carry is put aside before.
                aside = Held(value.shape, value.kind, block)
                statements.append(Statement([aside], code))
                code = self._copy(aside)
            copies.append((home(target), code))
        tested = self._copy(test) if test else None
        at_end = read_by(copies) | (tested.reads() if tested else set())
        levels = [merged(level) for level in levels_of(statements, at_end)]
        return Plan(levels, copies, tested, in_step)

    def _copy(self, value: Value) -> Code:
        return self.code(value, np.arange(value.size))

    def _statement(self, item: Map | Fold) -> Statement:
        if isinstance(item, Fold):
            code = self.code(item.arg, np.arange(item.arg.size).reshape(-1, item.terms))
            return Statement([item], code, item.op, item.terms, item.shared)
        code = Code()
        code.result = _Expression(self, code).compute(item, np.arange(item.size))
        return Statement([item], code)

    def _step(self, step: Step, in_step: bool) -> StepStatement:
        copied = zip(keeping.copied_by(step), step.writes, strict=False)
        copies = [(home(x), self._copy(value)) for value, x in copied if x.size]
        plans, which = [], None
        if isinstance(step, Loop):
            in_step = in_step and step.rounds is not None
            if step.test:
                plans.append(self._plan(step.test, test=step.going, in_step=False))
            plans.append(self._plan(step.inner, step.results, step.writes, in_step=in_step))
        if isinstance(step, Choice):
            which = self._copy(step.reads[0])
            for block, results in zip(step.branches, step.results, strict=True):
                plans.append(self._plan(block, results, step.writes, in_step=False))
        return StepStatement(step, copies, plans, which)

    def slots_of(self, constant: Const, index: np.ndarray) -> np.ndarray:
        """Returns the slots of a constant's numbers."""
        numbers = constant.array.reshape(-1)[index]
        memory = numbers.astype(np.float32 if constant.kind == "f" else np.int32)
        distinct, inverse = np.unique(memory.view(np.uint32), return_inverse=True)
        slots = [self.slots.setdefault(int(x), len(self.slots)) for x in distinct]
        return np.array(slots, np.int64)[inverse]


class _Expression:
    """Writes the code of one statement; what is the same at the same places is written once."""

    def __init__(self, scheduler: Scheduler, code: Code):
        """Begins with empty code."""
        self.scheduler, self.into = scheduler, code
        self.known: dict[Any, int] = {}

    def add(self, value: Value, places: np.ndarray) -> int:
        """Returns the line, or ~ the leaf, that has a value's numbers at places."""
        if isinstance(value, View):
            which, index = value.which[places], value.index[places]
            first = int(which.flat[0])
            if (which == first).all():
                return self.add(value.sources[first], index)
            return self._mixed(value, which, index)
        key = id(value), places.tobytes()
        if key not in self.known:
            if isinstance(value, Const):
                numbers = value.array.reshape(-1)[places]
                self.known[key] = self._leaf(Leaf(value.kind, (), places, numbers))
            elif isinstance(value, Held) or value in self.scheduler.keep:
                leaf = Leaf(value.kind, (home(value),), np.zeros_like(places), places)
                self.known[key] = self._leaf(leaf)
            else:
                assert isinstance(value, Map), "a fold is kept"
                self.known[key] = self.compute(value, places)
        return self.known[key]

    def compute(self, value: Map, places: np.ndarray) -> int:
        """Returns the line that computes a map's numbers at places."""
        args = tuple(self.add(arg, places) for arg in value.args)
        param = value.param
        if value.op == "lookup":
            param = len(self.into.tables)
            self.into.tables.append(value.param)
        self.into.lines.append(Line(value.op, value.kind, param, args))
        return len(self.into.lines) - 1

    def _mixed(self, value: View, which: np.ndarray, index: np.ndarray) -> int:
        """Returns the leaf for numbers of several values, all of which stand in memory."""
        index, sources = index.copy(), []
        for number, source in enumerate(value.sources):
            here = which == number
            if isinstance(source, Const):
                index[here] = self.scheduler.slots_of(source, index[here])
            sources.append(SLOTS if isinstance(source, Const) else home(source))
        return self._leaf(Leaf(value.kind, tuple(sources), which, index))

    def _leaf(self, leaf: Leaf) -> int:
        self.into.leaves.append(leaf)
        return ~(len(self.into.leaves) - 1)


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
        index = np.concatenate([part.index for part in parts])
        leaves.append(Leaf(parts[0].kind, sources, np.concatenate(which), index))
    first = statements[0]
    code = Code(first.code.lines, leaves, first.code.result)
    writes = [x for statement in statements for x in statement.writes]
    return Statement(writes, code, first.fold, first.terms)
