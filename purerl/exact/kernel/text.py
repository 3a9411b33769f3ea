"""Statements as C++ that is also CUDA: `prelude.h` has the words in which the two differ."""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from purerl.exact.kernel import lanes, memory, operations, side_by_side
from purerl.exact.kernel.cells import TYPES, Cells
from purerl.exact.kernel.lanes import LANES
from purerl.exact.kernel.parts import in_parts
from purerl.exact.kernel.reading import Program
from purerl.exact.kernel.schedule import Scheduler
from purerl.exact.kernel.statements import Code, Plan, Statement, StepStatement, needed_at_last
from purerl.exact.kernel.values import Choice, Linear, Loop, NoRuleError, Value, home

# What follows is of the fastest build on an H200 (lab/2026-11-29-one-kernel-on-a-cpu.md).
LOCKSTEP = 8  # levels from one barrier of a block to the next: its warps share fetched code
FEW_TERMS = 20  # a row of no more is written out, one of more is a loop
AT_ONCE = 64  # results that lanes sum in one loop: each takes a register
MOST_MEMORY = 1 << 16  # numbers: their places are kept in 16 bits


class Text(NamedTuple):
    """A kernel as text, and what its launch has to know."""

    body: str  # without the prelude
    memory: int  # numbers of 4 bytes for each environment
    statements: int
    inputs: tuple[tuple[int, str], ...]  # size and kind of each that is not empty
    outputs: tuple[tuple[int, str], ...]

    def __repr__(self) -> str:
        """Says how long it is: it stands in traces."""
        return f"{self.statements} statements"


def written(program: Program) -> Text:
    """Returns the text of a kernel; NoRuleError if an environment needs too much memory."""
    scheduler = Scheduler(program)
    address, size = memory.placed(scheduler, program.inputs)
    if size > MOST_MEMORY:
        raise NoRuleError(
            f"A kernel needs memory for {size:,} numbers of each environment, and has room "
            f"for {MOST_MEMORY:,}: leave this step to XLA."
        )
    writer = _Writer(scheduler, address)
    routines, lines = in_parts(writer.program(program))
    some = (program.inputs, program.outputs)
    sizes = [[(x.size, x.kind) for x in values if x.size] for values in some]
    places, constants = writer.tables.places, writer.tables.constants
    tables = [f"TABLE unsigned short T[] = {{{_numbers(places)}}};"]
    tables += [f"TABLE unsigned int C_[] = {{{_numbers(constants, 'u')}}};"]
    body = "\n".join([f"#define MEMORY {size}", "PRELUDE", *tables, *routines, *lines, ""])
    return Text(body, size, writer.statements, *(tuple(x) for x in sizes))


def _numbers(arrays: Sequence[np.ndarray], suffix: str = "") -> str:
    return ",".join(f"{x}{suffix}" for array in arrays for x in array) or "0"


class _Row(NamedTuple):
    """A sum that lanes share: one number of a statement, and which terms are added."""

    statement: Statement
    number: int
    terms: np.ndarray  # see `lanes.terms_of`

    def place(self) -> tuple[int, int]:
        """Returns where the loop over its terms begins and ends."""
        line = len(self.terms) and (np.diff(self.terms) == 1).all()
        first = int(self.terms[0]) if line else 0
        return first, first + len(self.terms)


class _Writer(Cells):
    """Writes one kernel."""

    def __init__(self, scheduler: Scheduler, address: dict[Value, int]):
        super().__init__(address)
        self.scheduler, self.statements = scheduler, 0

    def program(self, program: Program) -> Iterator[str]:
        """Yields the kernel: inputs are copied to memory, and results to the caller's arrays."""
        inputs = [x for x in program.inputs if x.size]
        outputs = [x for x in self.scheduler.outputs if x.size]
        words = [f"const {TYPES[x.kind]}* in{i}" for i, x in enumerate(inputs)]
        words += [f"{TYPES[x.kind]}* out{i}" for i, x in enumerate(outputs)]
        yield f"KERNEL(const int* environments, {', '.join(words)}) {{\nBEGIN"
        for number, value in enumerate(inputs):
            to = self.memory(value.kind, f"{self.address[value]}+i")
            yield f"{self.each(value.size)} {to} = in{number}[e*{value.size}+i];"
        lines = list(self._plan(self.scheduler.plan, copied=False))
        if self.scheduler.slots:
            slots = np.array(list(self.scheduler.slots), np.uint32).view(np.int32)
            at = self.tables.constant(slots, "i")
            yield f"{self.each(len(slots))} I[i] = (int)C_[{at}+i];"
        yield "SYNC;"
        yield from lines
        names: dict[Value, str] = {x: f"out{i}[e*{x.size}+i]" for i, x in enumerate(outputs)}
        yield "if (there) {"
        for target, code in self.scheduler.plan.copies:
            yield self.assign(names[target], target.size, code)
        yield "}\nEND }"

    # --- statements ---

    def _plan(self, plan: Plan, copied: bool = True, last: str = "") -> Iterator[str]:
        """Writes a block; `last` is C for whether it is the last round of a loop."""
        late = set(map(id, needed_at_last(plan))) if last else set()
        for number, level in enumerate(plan.levels):
            self.turn = 0
            if plan.in_step and number % LOCKSTEP == 0:
                yield "LOCKSTEP;"
            yield from self._level([x for x in level if id(x) not in late])
            if waits := [x for x in level if id(x) in late]:
                yield from (f"if ({last}) {{", *self._level(waits), "}")
            yield "SYNC;"
            self.statements += len(level)
        if copied and plan.copies:
            yield from self._jobs([self.job(*x) for x in plan.copies if id(x) not in late])
            if then := [self.job(*x) for x in plan.copies if id(x) in late]:
                yield from (f"if ({last}) {{", *self._jobs(then), "}")
            yield "SYNC;"

    def _level(self, level: Sequence[Statement | StepStatement]) -> Iterator[str]:
        plain = [x for x in level if isinstance(x, Statement)]
        shared = sorted((x for x in plain if x.shared), key=_shape)
        for _, some in itertools.groupby(shared, _shape):
            yield from self._shared(list(some))
        others = [x for x in plain if not x.shared]
        yield from map(self._fold, (x for x in others if x.terms > FEW_TERMS))
        yield from self._jobs([self._job(x) for x in others if x.terms <= FEW_TERMS])
        for step in level:
            if isinstance(step, StepStatement):
                yield from self._step(step)

    def _jobs(self, jobs: Sequence[side_by_side.Job]) -> Iterator[str]:
        """Writes what is independent: see `side_by_side`."""
        parts = [side_by_side.parts_of(job) for job in jobs]
        for group in side_by_side.groups([x for some in parts for x in some]):
            yield f"{self.one()} {side_by_side.group_text(group)}"
        for job, some in zip(jobs, parts, strict=True):
            if not some:
                yield side_by_side.loop_text(job, self.turns(job.size))

    def _job(self, statement: Statement) -> side_by_side.Job:
        """Each lane makes a row of few terms one number, from its first term to its last."""
        first, code, terms = statement.writes[0], statement.code, statement.terms
        job = self.job(first, code, statement.size)
        if not statement.fold:
            return job

        def lines(place: str, name: str) -> tuple[list[str], str]:
            body: list[str] = []
            found = ""
            for term in range(terms):
                leaves = [self.term(leaf, term, place) for leaf in code.leaves]
                some, result = self.code(code, leaves, f"{name}_{term}")
                if term:
                    result = operations.text_of(statement.fold, first.kind, None, found, result)
                    some.append(f"{TYPES[first.kind]} {name}s{term} = {result};")
                    result = f"{name}s{term}"
                body, found = body + some, result
            return body, found

        return job._replace(reads=terms * job.reads, lines=lines)

    def _fold(self, statement: Statement) -> str:
        """Each lane makes a row of many terms one number, from its first term to its last."""
        first, code = statement.writes[0], statement.code
        lines, result = self.code(code, [self.term(leaf, None) for leaf in code.leaves])
        result = operations.text_of(statement.fold, first.kind, None, "sum", result)
        start = operations.neutral(statement.fold, first.kind)
        body = [f"{TYPES[first.kind]} sum = {start};", f"ROUNDS(j, {statement.terms}) {{", *lines]
        body += [f"sum = {result};", "}", f"{self.target(first)('i')} = sum;"]
        return f"{self.each(statement.size)} {{ {' '.join(body)} }}"

    def _shared(self, statements: list[Statement]) -> Iterator[str]:
        """The lanes share each row. Rows of equal length are in one loop, and read once."""
        fold, _, kind = _shape(statements[0])
        rows = [row for x in statements for row in _rows(x)]
        rows.sort(key=_Row.place)
        for start in range(0, len(rows), AT_ONCE):
            some = rows[start : start + AT_ONCE]
            count, neutral = _padded(len(some)), operations.neutral(fold, kind)
            lines = [f"{self.one()} {{ SUMS({TYPES[kind]}, {count}, {neutral})"]
            for (first, end), alike in itertools.groupby(enumerate(some), lambda x: x[1].place()):
                if end > first:  # else all of its terms are 0
                    lines.append(f"LANES(i, {first}, {end}) {{ {self._sums(fold, kind, alike)} }}")
            to = self.tables.place(np.array([self.address[x.writes[0]] + n for x, n, _ in some]))
            memory = "P" if kind == "f" else "I"
            lines.append(f"PUT(joined_by_{fold}, {count}, {len(some)}, {memory}, T+{to}) }}")
            yield "\n".join(lines)

    def _sums(self, fold: str, kind: str, rows: Iterator[tuple[int, _Row]]) -> str:
        """Returns C that adds a term to each of some rows, by the number of its sum."""
        body: dict[str, str] = {}  # C -> its name
        sums = []
        for number, row in rows:
            result = self._row(row, body)
            text = operations.text_of(fold, kind, None, f"SUM({number})", result)
            sums.append(f"SUM({number}) = {text};")
        return " ".join([*(f"auto {name} = {text};" for text, name in body.items()), *sums])

    def _row(self, row: _Row, known: dict[str, str]) -> str:
        """Adds the lines for a term of one row to those known; returns the name of the term."""

        def name(text: str) -> str:
            return known.setdefault(text, f"v{len(known)}")

        code, at = row.statement.code, (row.number, row.terms)
        leaves = [x._replace(which=x.which[at], at=x.at[at]) for x in code.leaves]
        i = f"(i-{row.place()[0]})" if row.place()[0] else "i"
        names = [name(self.leaf(leaf, i)) for leaf in leaves]
        results: list[str] = []
        for line in code.lines:
            args = [names[~arg] if arg < 0 else results[arg] for arg in line.args]
            results.append(name(self.operation(code, line, args)))
        return names[~code.result] if code.result < 0 else results[code.result]

    # --- steps ---

    def _step(self, statement: StepStatement) -> Iterator[str]:
        yield from self._jobs([self.job(value, code) for value, code in statement.copies])
        yield "SYNC;"
        step = statement.step
        if isinstance(step, Linear):
            yield self._linear(step, statement.matrices)
        elif isinstance(step, Choice):
            yield from self._choice(statement)
        else:
            assert isinstance(step, Loop)
            yield from self._loop(step, statement.plans)

    def _loop(self, step: Loop, plans: Sequence[Plan]) -> Iterator[str]:
        if step.rounds is not None:
            last = f"round{step.inner.depth} == {step.rounds - 1}"
            yield f"REPEAT(round{step.inner.depth}, {step.rounds}) {{"
        else:
            last = ""
            yield "for (;;) {"
            yield from self._plan(plans[0])
            assert plans[0].test
            yield f"{self._uniform(plans[0].test)} if (!which) break;"
        yield from self._plan(plans[-1], last=last)
        yield "}"

    def _choice(self, statement: StepStatement) -> Iterator[str]:
        assert statement.which
        yield f"{{ {self._uniform(statement.which)}"
        last = len(statement.plans) - 1
        for number, plan in enumerate(statement.plans):
            test = f"if (which <= {number})" if number < last else ""
            yield f"{'else ' if number else ''}{test} {{"
            yield from self._plan(plan)
            yield "}"
        yield "}"

    def _uniform(self, code: Code) -> str:
        """Returns C that sets `which` to one number, the same in all lanes: see UNIFORM."""
        lines, result = self.code(code, [self.leaf(leaf, "0") for leaf in code.leaves])
        return f"int which; {{ {' '.join(lines)} which = UNIFORM({result}); }}"

    def _linear(self, step: Linear, matrices: Sequence[Value]) -> str:
        (target,), n = step.writes, step.reads[0].shape[0]
        to = self.address[home(target)]
        if step.op == "cholesky":
            whose = self.one() if n <= LANES else ""
            return f"{whose} cholesky<{n}>(P + {to}, thread);"
        matrix = self.address[matrices[0]]
        steps = f"1, {n}" if step.transposed else f"{n}, 1"
        forward = int(step.lower != step.transposed)
        return f"{self.one()} solve<{n}, {steps}, {forward}>(P + {matrix}, P + {to}, lane);"


def _shape(statement: Statement) -> tuple[str, int, str]:
    return statement.fold, statement.terms, statement.writes[0].kind


def _rows(statement: Statement) -> list[_Row]:
    assert statement.zero is not None
    terms = lanes.terms_of(statement.zero)
    return [_Row(statement, number, some) for number, some in enumerate(terms)]


def _padded(number: int) -> int:
    """Returns how many results lanes sum: a power of 2, or a multiple of LANES; see `put`."""
    return 1 << (number - 1).bit_length() if number < LANES else -(-number // LANES) * LANES
