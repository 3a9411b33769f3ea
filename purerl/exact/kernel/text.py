"""Statements as C++ that is also CUDA: `prelude.h` has the words in which the two differ."""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from purerl.exact.kernel import indices, memory, operations
from purerl.exact.kernel.lanes import LANES
from purerl.exact.kernel.reading import Program
from purerl.exact.kernel.schedule import (
    Code,
    Line,
    Leaf,
    Plan,
    Scheduler,
    Statement,
    StepStatement,
)
from purerl.exact.kernel.values import Choice, Const, Fold, Linear, Loop, NoRuleError, Value, home

# What follows is of the fastest build on an H200 (lab/2026-11-29-one-kernel-on-a-cpu.md).
LOCKSTEP = 4  # levels from one barrier of a block to the next: its warps share fetched code
FEW_TERMS = 20  # a row of no more is written out, one of more is a loop
AT_ONCE = 128  # results that lanes sum in one loop: each takes a register
MOST_MEMORY = 1 << 16  # numbers: their places are kept in 16 bits
TYPES = {"f": "float", "i": "int", "b": "int"}


class Text(NamedTuple):
    """A kernel as text, and what its launch has to know."""

    body: str  # without the prelude
    memory: int  # numbers of 4 bytes for each environment
    live: int  # of these needed at once
    statements: int
    inputs: tuple[tuple[int, str], ...]  # size and kind of each that is not empty
    outputs: tuple[tuple[int, str], ...]

    def __repr__(self) -> str:
        """Says how long it is: it stands in traces."""
        return f"{self.statements} statements"


def written(program: Program) -> Text:
    """Returns the text of a kernel; NoRuleError if an environment needs too much memory."""
    scheduler = Scheduler(program)
    placed = memory.placed(scheduler, program.inputs)
    if placed.size > MOST_MEMORY:
        raise NoRuleError(
            f"A kernel needs memory for {placed.size:,} numbers of each environment, and has room "
            f"for {MOST_MEMORY:,}: leave this step to XLA."
        )
    writer = _Writer(scheduler, placed)
    lines = list(writer.program(program))
    some = (program.inputs, program.outputs)
    sizes = [[(x.size, x.kind) for x in values if x.size] for values in some]
    tables = [f"TABLE unsigned short T[] = {{{_numbers(writer.tables.places)}}};",
              f"TABLE unsigned int C_[] = {{{_numbers(writer.tables.constants, 'u')}}};"]  # fmt: skip
    body = "\n".join([f"#define MEMORY {placed.size}", "PRELUDE", *tables, *lines, ""])
    counts = placed.size, placed.live, writer.statements
    return Text(body, *counts, *(tuple(x) for x in sizes))


def _numbers(arrays: Sequence[np.ndarray], suffix: str = "") -> str:
    return ",".join(f"{x}{suffix}" for array in arrays for x in array) or "0"


class _Writer:
    """Writes one kernel: its text refers to memory and to tables by number."""

    def __init__(self, scheduler: Scheduler, placed: memory.Memory):
        self.scheduler, self.address = scheduler, placed.address
        self.tables, self.statements = indices.Tables(), 0

    def program(self, program: Program) -> Iterator[str]:
        """Yields the kernel: inputs are copied to memory, and results to the caller's arrays."""
        inputs = [x for x in program.inputs if x.size]
        outputs = [x for x in self.scheduler.outputs if x.size]
        words = [f"const {TYPES[x.kind]}* in{i}" for i, x in enumerate(inputs)]
        words += [f"{TYPES[x.kind]}* out{i}" for i, x in enumerate(outputs)]
        yield f"KERNEL(const int* environments, {', '.join(words)}) {{\nBEGIN"
        for number, value in enumerate(inputs):
            to = self._memory(value.kind, f"{self.address[value]}+i")
            yield f"{_each(value.size)} {to} = in{number}[e*{value.size}+i];"
        lines = list(self._plan(self.scheduler.plan, copied=False))
        if self.scheduler.slots:
            slots = np.array(list(self.scheduler.slots), np.uint32).view(np.int32)
            at = self.tables.constant(slots, "i")
            yield f"{_each(len(slots))} I[i] = (int)C_[{at}+i];"
        yield "SYNC;"
        yield from lines
        names = {x: f"out{i}[e*{x.size}+i]" for i, x in enumerate(outputs)}
        yield "if (there) {"
        for value, code in self.scheduler.plan.copies:
            yield self._assign(names[value], value.size, code)
        yield "}\nEND }"

    # --- numbers of memory and of constants ---

    def _memory(self, kind: str, place: str) -> str:
        return f"{'P' if kind == 'f' else 'I'}[{place}]"

    def _addresses(self, leaf: Leaf) -> np.ndarray:
        base = np.array([self.address[x] for x in leaf.sources])
        return base[leaf.which] + leaf.index

    def _constant(self, numbers: np.ndarray, kind: str, place: str) -> str:
        """Returns C for constants; `place` is C for which of them."""
        first = numbers.flat[0]
        if (numbers == first).all() or (numbers != numbers).all():
            return _literal(first, kind)
        at = f"{self.tables.constant(numbers, kind)}+{place}"
        return f"C[{at}]" if kind == "f" else f"((int)C_[{at}])"

    def _leaf(self, leaf: Leaf, number: str = "i") -> str:
        """Returns C for a leaf [n] at a place."""
        if not leaf.sources:
            return self._constant(leaf.index, leaf.kind, number)
        return self._memory(leaf.kind, indices.text(self.tables, self._addresses(leaf), number))

    def _term(self, leaf: Leaf, term: int | None) -> str:
        """Returns C for a leaf [rows, terms] at row i, and at a term or, of None, at term j."""
        if term is not None:
            return self._leaf(leaf._replace(which=leaf.which[:, term], index=leaf.index[:, term]))
        rows, terms = leaf.index.shape
        if not leaf.sources:
            return self._constant(np.ascontiguousarray(leaf.index.T), leaf.kind, f"{rows}*j+i")
        at = self._addresses(leaf)
        first, along = at[:, 0], at[0] - at[0, 0]
        if (at == first[:, None] + along).all():
            first, along = first + along.min(), along - along.min()
            place = f"{indices.text(self.tables, first)}+{indices.text(self.tables, along, 'j')}"
        else:
            place = indices.text(self.tables, np.ascontiguousarray(at.T).reshape(-1), f"{rows}*j+i")
        return self._memory(leaf.kind, place)

    def _code(self, code: Code, leaves: Sequence[str]) -> tuple[list[str], str]:
        """Returns the lines that compute one number, given C for its leaves, and its name."""
        lines = [f"{TYPES[x.kind]} l{i} = {text};"
                 for i, (x, text) in enumerate(zip(code.leaves, leaves, strict=True))]  # fmt: skip
        for number, line in enumerate(code.lines):
            args = [_name(arg) for arg in line.args]
            text = self._operation(code, line, args)
            lines.append(f"{TYPES[line.kind]} t{number} = {text};")
        return lines, _name(code.result)

    def _operation(self, code: Code, line: Line, args: list[str]) -> str:
        if line.op != "lookup":
            return operations.text_of(line.op, line.kind, line.param, *args)
        table = code.tables[line.param]
        if isinstance(table, Const):
            at = self.tables.constant(table.array, table.kind)
            return f"C[{at}+{args[0]}]" if line.kind == "f" else f"((int)C_[{at}+{args[0]}])"
        return self._memory(line.kind, f"{self.address[home(table)]}+{args[0]}")

    def _assign(self, target: str, size: int, code: Code) -> str:
        lines, result = self._code(code, [self._leaf(leaf) for leaf in code.leaves])
        return f"{_each(size)} {{ {' '.join(lines)} {target} = {result}; }}"

    def _copy(self, value: Value, code: Code) -> str:
        target = self._memory(value.kind, f"{self.address[value]}+i")
        return self._assign(target, value.size, code)

    # --- statements ---

    def _plan(self, plan: Plan, copied: bool = True) -> Iterator[str]:
        for number, level in enumerate(plan.levels):
            if plan.in_step and number % LOCKSTEP == 0:
                yield "LOCKSTEP;"
            plain = [x for x in level if isinstance(x, Statement)]
            shared = sorted((x for x in plain if x.shared), key=_shape)
            for _, some in itertools.groupby(shared, _shape):
                yield from self._shared(list(some))
            for statement in plain:
                if not statement.shared:
                    yield self._fold(statement) if statement.fold else self._map(statement)
            for statement in level:
                if isinstance(statement, StepStatement):
                    yield from self._step(statement)
            yield "SYNC;"
            self.statements += len(level)
        if copied and plan.copies:
            yield from (self._copy(value, code) for value, code in plan.copies)
            yield "SYNC;"

    def _map(self, statement: Statement) -> str:
        first = statement.writes[0]
        target = self._memory(first.kind, f"{self.address[first]}+i")
        return self._assign(target, statement.size, statement.code)

    def _fold(self, statement: Statement) -> str:
        """Each lane makes a row one number, from its first term to its last."""
        first, code, terms = statement.writes[0], statement.code, statement.terms
        join = lambda x: operations.text_of(statement.fold, first.kind, None, "sum", x)  # noqa: E731
        if terms <= FEW_TERMS:
            body = [f"{TYPES[first.kind]} sum;"]
            for term in range(terms):
                lines, result = self._code(code, [self._term(leaf, term) for leaf in code.leaves])
                body.append(f"{{ {' '.join(lines)} sum = {join(result) if term else result}; }}")
        else:
            lines, result = self._code(code, [self._term(leaf, None) for leaf in code.leaves])
            start = operations.neutral(statement.fold, first.kind)
            body = [f"{TYPES[first.kind]} sum = {start};", f"ROUNDS(j, {terms}) {{", *lines]
            body += [f"sum = {join(result)};", "}"]
        target = self._memory(first.kind, f"{self.address[first]}+i")
        return f"{_each(statement.size)} {{ {' '.join(body)} {target} = sum; }}"

    def _shared(self, statements: list[Statement]) -> Iterator[str]:
        """The lanes share each row. Rows of equal length are in one loop, and read once."""
        fold, terms, kind = _shape(statements[0])
        rows = [(x, row) for x in statements for row in _distinct_rows(x)]
        for start in range(0, len(rows), AT_ONCE):
            some = rows[start : start + AT_ONCE]
            body: dict[str, str] = {}  # C -> its name
            sums = []
            for number, (statement, row) in enumerate(some):
                result = self._row(statement.code, row, body)
                text = operations.text_of(fold, kind, None, f"SUM({number})", result)
                sums.append(f"SUM({number}) = {text};")
            lines = [f"auto {name} = {text};" for text, name in body.items()]
            count = 1 << (len(some) - 1).bit_length() if len(some) < LANES else -(-len(some) // LANES) * LANES
            neutral = operations.neutral(fold, kind)
            yield f"{{ SUMS({TYPES[kind]}, {count}, {neutral})"
            yield f"EACH(i, {terms}) {{ {' '.join(lines + sums)} }}"
            to, also = (self.tables.place(x) for x in self._targets(some))
            memory = "P" if kind == "f" else "I"
            yield f"PUT(joined_by_{fold}, {count}, {len(some)}, {memory}, T+{to}, T+{also}) }}"

    def _row(self, code: Code, row: int, known: dict[str, str]) -> str:
        """Adds the lines for a term of one row to those known; returns the name of the term."""

        def name(text: str) -> str:
            return known.setdefault(text, f"v{len(known)}")

        leaves = [leaf._replace(which=leaf.which[row], index=leaf.index[row])
                  if leaf.sources else leaf._replace(index=leaf.index[row])
                  for leaf in code.leaves]  # fmt: skip
        texts = [self._leaf(leaf) for leaf in leaves]
        names = [name(text) for text in texts]
        results: list[str] = []
        for line in code.lines:
            args = [names[~arg] if arg < 0 else results[arg] for arg in line.args]
            results.append(name(self._operation(code, line, args)))
        return names[~code.result] if code.result < 0 else results[code.result]

    def _targets(self, rows: Sequence[tuple[Statement, int]]) -> tuple[np.ndarray, np.ndarray]:
        """Returns where each row's result is put, and where a second time: see `_distinct_rows`."""
        first = [self.address[statement.writes[0]] for statement, _ in rows]
        to = np.array([row for _, row in rows])
        also = [_mirrored(statement, row) for statement, row in rows]
        return np.array(first) + to, np.array(first) + np.array(also)

    # --- steps ---

    def _step(self, statement: StepStatement) -> Iterator[str]:
        yield from (self._copy(value, code) for value, code in statement.copies)
        yield "SYNC;"
        step = statement.step
        if isinstance(step, Linear):
            yield self._linear(step)
        elif isinstance(step, Choice):
            yield from self._choice(statement)
        else:
            assert isinstance(step, Loop)
            yield from self._loop(step, statement.plans)

    def _loop(self, step: Loop, plans: Sequence[Plan]) -> Iterator[str]:
        if step.rounds is not None:
            yield f"ROUNDS(round{step.inner.depth}, {step.rounds}) {{"
        else:
            yield "for (;;) {"
            yield from self._plan(plans[0])
            assert plans[0].test
            yield f"{self._uniform(plans[0].test)} if (!which) break;"
        yield from self._plan(plans[-1])
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
        lines, result = self._code(code, [self._leaf(leaf, "0") for leaf in code.leaves])
        return f"int which; {{ {' '.join(lines)} which = UNIFORM({result}); }}"

    def _linear(self, step: Linear) -> str:
        (target,), n = step.writes, step.reads[0].shape[0]
        to = self.address[home(target)]
        if step.op == "cholesky":
            return f"cholesky<{n}>(P + {to}, lane);"
        matrix = self.address[home(step.reads[0])]
        steps = f"1, {n}" if step.transposed else f"{n}, 1"
        forward = int(step.lower != step.transposed)
        return f"solve<{n}, {steps}, {forward}>(P + {matrix}, P + {to}, lane);"


def _shape(statement: Statement) -> tuple[str, int, str]:
    return statement.fold, statement.terms, statement.writes[0].kind


def _width(statement: Statement) -> int:
    """Returns n if a shared fold's rows are a symmetric [n, n], else 0."""
    (fold,) = statement.writes
    return fold.width if isinstance(fold, Fold) else 0


def _distinct_rows(statement: Statement) -> list[int]:
    """Returns the rows to sum: of a symmetric square those of its lower half."""
    n = _width(statement)
    return [r * n + c for r in range(n) for c in range(r + 1)] or list(range(statement.size))


def _mirrored(statement: Statement, row: int) -> int:
    n = _width(statement)
    return row % n * n + row // n if n else row


def _each(size: int) -> str:
    return f"EACH(i, {size})" if size > LANES else f"FEW(i, {size})"


def _name(number: int) -> str:
    return f"t{number}" if number >= 0 else f"l{~number}"


def _literal(number: float, kind: str) -> str:
    if kind != "f":
        return str(int(number))
    if number != number:
        return "NAN"
    return f"{float(number)!r}f" if np.isfinite(number) else "INFINITY" if number > 0 else "-INFINITY"

