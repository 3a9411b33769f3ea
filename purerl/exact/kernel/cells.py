"""C for single numbers: of memory, of constants, and what is computed of them."""

from collections.abc import Callable, Sequence

import numpy as np

from purerl.exact.kernel import indices, operations
from purerl.exact.kernel.lanes import LANES
from purerl.exact.kernel.side_by_side import Job
from purerl.exact.kernel.statements import Code, Leaf, Line
from purerl.exact.kernel.values import Const, Value, home

TYPES = {"f": "float", "i": "int", "b": "int"}


class Cells:
    """The memory of an environment and the tables that all of them read, as C."""

    def __init__(self, address: dict[Value, int]):
        """Begins with empty tables.

        Args:
          address: where each value stands in memory, by its home.
        """
        self.address, self.tables, self.turn = address, indices.Tables(), 0

    def each(self, size: int) -> str:
        """Returns C that does something for each i; the warps of an environment take turns."""
        return f"{'EACH' if size > LANES else 'FEW'}({self.turns(size)}, i, {size})"

    def one(self) -> str:
        """Returns C that lets the warp whose turn it is do something alone."""
        return f"ONE({self.turns(1)})"

    def turns(self, size: int) -> int:
        """Returns whose turn it is; so many numbers are a turn for each warp's worth of them."""
        turn, self.turn = self.turn, self.turn + -(-size // LANES)
        return turn

    def memory(self, kind: str, place: str) -> str:
        """Returns C for a number in memory."""
        return f"{'P' if kind == 'f' else 'I'}[{place}]"

    def addresses(self, leaf: Leaf) -> np.ndarray:
        """Returns where the numbers of a leaf stand in memory."""
        base = np.array([self.address[x] for x in leaf.sources])
        return base[leaf.which] + leaf.at

    def constant(self, numbers: np.ndarray, kind: str, place: str) -> str:
        """Returns C for constants; `place` is C for which of them."""
        first = numbers.flat[0]
        signs = 1.0 * np.signbit(numbers) if kind == "f" else 0  # -0 is not 0
        if (numbers == first).all() and np.ptp(signs) == 0 or (numbers != numbers).all():
            return _literal(first, kind)
        return _of_table(kind, f"{self.tables.constant(numbers, kind)}+{place}")

    def leaf(self, leaf: Leaf, number: str = "i") -> str:
        """Returns C for a leaf [n] at a place."""
        if not leaf.sources:
            return self.constant(leaf.at, leaf.kind, number)
        return self.memory(leaf.kind, indices.text(self.tables, self.addresses(leaf), number))

    def term(self, leaf: Leaf, term: int | None, number: str = "i") -> str:
        """Returns C for a leaf [rows, terms] at a row, and at a term or, of None, at term j."""
        if term is not None:
            return self.leaf(leaf._replace(which=leaf.which[:, term], at=leaf.at[:, term]), number)
        rows, terms = leaf.at.shape
        if not leaf.sources:
            return self.constant(np.ascontiguousarray(leaf.at.T), leaf.kind, f"{rows}*j+i")
        at = self.addresses(leaf)
        first, along = at[:, 0], at[0] - at[0, 0]
        if (at == first[:, None] + along).all():
            first, along = first + along.min(), along - along.min()
            place = f"{indices.text(self.tables, first)}+{indices.text(self.tables, along, 'j')}"
        else:
            place = indices.text(self.tables, np.ascontiguousarray(at.T).reshape(-1), f"{rows}*j+i")
        return self.memory(leaf.kind, place)

    def code(self, code: Code, leaves: Sequence[str], name: str = "") -> tuple[list[str], str]:
        """Returns the lines that compute one number, given C for its leaves, and its name.

        All names begin with `name`.
        """
        named = lambda number: name + (f"t{number}" if number >= 0 else f"l{~number}")  # noqa: E731
        lines = [f"{TYPES[x.kind]} {named(~i)} = {text};"
                 for i, (x, text) in enumerate(zip(code.leaves, leaves, strict=True))]  # fmt: skip
        for number, line in enumerate(code.lines):
            text = self.operation(code, line, [named(arg) for arg in line.args])
            lines.append(f"{TYPES[line.kind]} {named(number)} = {text};")
        return lines, named(code.result)

    def operation(self, code: Code, line: Line, args: list[str]) -> str:
        """Returns C for a line, given C for its arguments."""
        if line.op != "lookup":
            return operations.text_of(line.op, line.kind, line.param, *args)
        table = code.tables[line.param]
        if isinstance(table, Const):
            return _of_table(line.kind, f"{self.tables.constant(table.array, line.kind)}+{args[0]}")
        return self.memory(line.kind, f"{self.address[home(table)]}+{args[0]}")

    def assign(self, target: str, size: int, code: Code) -> str:
        """Returns C that computes numbers and puts them where `target` says."""
        lines, result = self.code(code, [self.leaf(leaf) for leaf in code.leaves])
        return f"{self.each(size)} {{ {' '.join(lines)} {target} = {result}; }}"

    def job(self, value: Value, code: Code, size: int = 0) -> Job:
        """Returns what computes numbers, by default a value's, and puts them where it stands."""

        def lines(place: str, name: str) -> tuple[list[str], str]:
            return self.code(code, [self.leaf(leaf, place) for leaf in code.leaves], name)

        return Job(size or value.size, max(1, len(code.leaves)), lines, self.target(value))

    def target(self, value: Value) -> Callable[[str], str]:
        """Returns C for a value's number at a place."""
        return lambda place: self.memory(value.kind, f"{self.address[value]}+{place}")


def _of_table(kind: str, place: str) -> str:
    return f"C[{place}]" if kind == "f" else f"((int)C_[{place}])"


def _literal(number: float, kind: str) -> str:
    if kind != "f":
        return str(int(number))
    if number != number:
        return "NAN"
    if np.isinf(number):
        return "INFINITY" if number > 0 else "-INFINITY"
    return f"{float(number)!r}f"
