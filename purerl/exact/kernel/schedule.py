"""From values to statements, in levels: no statement of a level reads what another of it writes."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from purerl.exact.kernel import keeping, statements, values
from purerl.exact.kernel.levels import levels_of
from purerl.exact.kernel.reading import Program
from purerl.exact.kernel.statements import SLOTS, Code, Leaf, Line, Plan, Statement, StepStatement
from purerl.exact.kernel.values import Block, Const, Fold, Held, Map, Value, View, home

Pairs = Sequence[tuple[Value, Held]]


class _Row(NamedTuple):
    """The numbers of a value that stand in memory: those that are read."""

    home: Held
    places: np.ndarray
    ranks: np.ndarray  # of each number of the value its place in `home`, or -1


class Scheduler:
    """Writes the statements of one program: `plan`, the homes of its `outputs`, and `slots`."""

    def __init__(self, program: Program):
        """Decides what is kept, and plans all blocks."""
        # Single constants that stand in memory, each by its bits.
        self.slots: dict[int, int] = {}
        self.zeros = program.zeros
        self.keep = {
            x: _Row(Held(places.shape, x.kind, x.block), places, _ranks(places, x.size))
            for x, places in keeping.kept(program.block, program.outputs, program.zeros).items()
        }
        self.outputs = [Held(x.shape, x.kind, program.block) for x in program.outputs]
        pairs = list(zip(program.outputs, self.outputs, strict=True))
        self.plan = self._plan(program.block, pairs, True)

    def home(self, value: Value) -> Value:
        """Returns the value in whose memory a value stands."""
        return self.keep[value].home if value in self.keep else home(value)

    def code(self, value: Value, places: np.ndarray) -> Code:
        """Returns the code of a value's numbers at places, [...]."""
        code = Code()
        code.result = _Expression(self, code).add(value, places)
        return code

    def _plan(self, block: Block, pairs: Pairs, in_step: bool, test: Value | None = None) -> Plan:
        """Plans a block, of which each pair (result, target) is copied at its end."""
        made: list[Any] = []
        for item in block.items:
            if isinstance(item, values.Step):
                made.append(self._step(item, in_step))
            elif item in self.keep:
                made.append(self._statement(item))
        copies, homes = [], {home(x) for _, x in pairs}
        for value, target in pairs:
            if self.home(value) is home(target) or not value.size:
                continue
            code = self._copy(value)
            if code.reads() & homes:
                # Copies are made one after another: what reads the carry is put aside before.
                aside = Held(value.shape, value.kind, block)
                made.append(Statement([aside], code))
                code = self._copy(aside)
            copies.append((home(target), code))
        tested = self._copy(test) if test else None
        at_end = statements.read_by(copies) | (tested.reads() if tested else set())
        levels = [statements.merged(level) for level in levels_of(made, at_end)]
        return Plan(levels, copies, tested, in_step)

    def _copy(self, value: Value) -> Code:
        return self.code(value, np.arange(value.size))

    def _statement(self, item: Map | Fold) -> Statement:
        row = self.keep[item]
        if isinstance(item, Fold):
            terms = item.arg.places.reshape(-1, item.terms)[row.places]
            zero = self.zeros.of(item.arg)[terms] & (item.op == "add")
            code = self.code(item.arg, terms)
            return Statement([row.home], code, item.op, item.terms, item.shared, zero)
        code = Code()
        code.result = _Expression(self, code).compute(item, row.places)
        return Statement([row.home], code)

    def _step(self, step: values.Step, in_step: bool) -> StepStatement:
        copied = zip(keeping.copied_by(step), step.writes, strict=False)
        copies = [(home(x), self._copy(value)) for value, x in copied if x.size]
        plans, which = [], None
        matrices: list[Value] = []
        if isinstance(step, values.Linear):
            matrices = [self.home(x) for x in step.reads[:-1]]
        if isinstance(step, values.Loop):
            in_step = in_step and step.rounds is not None
            if step.test:
                plans.append(self._plan(step.test, [], False, step.going))
            pairs = list(zip(step.results, step.writes, strict=True))
            plans.append(self._plan(step.inner, pairs, in_step))
        if isinstance(step, values.Choice):
            which = self._copy(step.reads[0])
            for block, results in zip(step.branches, step.results, strict=True):
                plans.append(self._plan(block, [*zip(results, step.writes, strict=True)], False))
        return StepStatement(step, copies, plans, which, matrices)

    def slots_of(self, constant: Const, index: np.ndarray) -> np.ndarray:
        """Returns the slots of a constant's numbers."""
        numbers = constant.array.reshape(-1)[index]
        memory = numbers.astype(np.float32 if constant.kind == "f" else np.int32)
        distinct, inverse = np.unique(memory.view(np.uint32), return_inverse=True)
        slots = [self.slots.setdefault(int(x), len(self.slots)) for x in distinct]
        return np.array(slots, np.int64)[inverse]


def _ranks(places: np.ndarray, size: int) -> np.ndarray:
    found = np.full(size, -1)
    found[places] = np.arange(len(places))
    return found


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
            return self._standing(value.sources, which, index)
        key = id(value), places.tobytes()
        if key not in self.known:
            if isinstance(value, Const):
                numbers = value.array.reshape(-1)[places]
                self.known[key] = self._leaf(Leaf(value.kind, (), places, numbers))
            elif isinstance(value, Held) or value in self.scheduler.keep:
                self.known[key] = self._standing([value], np.zeros_like(places), places)
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
            self.into.tables.append(self.scheduler.home(value.param))
        self.into.lines.append(Line(value.op, value.kind, param, args))
        return len(self.into.lines) - 1

    def _standing(self, sources: Sequence[Value], which: np.ndarray, index: np.ndarray) -> int:
        """Returns the leaf for numbers of values that stand in memory (see `View`)."""
        homes: list[Value] = [SLOTS]
        group, at = np.zeros_like(index), np.empty_like(index)
        for number in np.unique(which):
            here, source = which == number, sources[number]
            if isinstance(source, Const):
                at[here] = self.scheduler.slots_of(source, index[here])
                continue
            row = self.scheduler.keep.get(source)
            at[here] = row.ranks[index[here]] if row else index[here]
            group[here] = len(homes)
            homes.append(self.scheduler.home(source))
        if (at < 0).any():  # known to be 0
            group[at < 0] = 0
            at[at < 0] = self.scheduler.slots.setdefault(0, len(self.scheduler.slots))
        return self._leaf(Leaf(sources[0].kind, tuple(homes), group, at))

    def _leaf(self, leaf: Leaf) -> int:
        self.into.leaves.append(leaf)
        return ~(len(self.into.leaves) - 1)
