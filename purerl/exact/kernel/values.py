"""What a kernel computes: the values of a trace and the steps that make some of them.

A value has a shape only for the rules that read a trace; for all later stages it is a row of
numbers, [size], in row-major order. Most of a trace of MJX is indexing. Here that is a `View`, a
numpy array of places, and costs nothing when the kernel runs.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

# None of these has a `repr`: each names others, down to the first, and a traceback would never end.
DTYPES = {"f": np.float32, "i": np.int32, "b": np.bool_}


class NoRuleError(NotImplementedError):
    """An equation that no kernel can compute; the message names its primitive and its line."""


@dataclass(eq=False, repr=False)
class Block:
    """What runs together: the whole kernel, a loop's condition or body, or a branch."""

    role: str  # "top", "scan", "while" or "branch"
    depth: int = 0
    items: list[Any] = field(default_factory=list)  # maps, folds and steps, in a possible order
    known: dict[Any, "Value"] = field(default_factory=dict)  # what is computed here, by its parts


@dataclass(eq=False, repr=False)
class Value:
    """Numbers of one kind: "f" float32, "i" int32, "b" bool (in memory as int32)."""

    shape: tuple[int, ...]
    kind: str
    block: Block

    @property
    def size(self) -> int:
        """How many numbers there are."""
        return math.prod(self.shape)

    @property
    def places(self) -> np.ndarray:
        """The place of each number in the row, in the value's own shape."""
        return np.arange(self.size).reshape(self.shape)


@dataclass(eq=False, repr=False)
class Const(Value):
    """Numbers that are known before the kernel runs."""

    array: np.ndarray

    def is_all(self, number: float) -> bool:
        """Tells whether each of at least one number is this one."""
        return bool(self.array.size and (self.array == number).all())


@dataclass(eq=False, repr=False)
class Held(Value):
    """Numbers that a step or the caller has put into memory."""

    home: "Held | None" = None  # the value whose memory this one names, if it is not its own


@dataclass(eq=False, repr=False)
class View(Value):
    """Numbers of other values: number i is `sources[which[i]][index[i]]`. Never of a view."""

    sources: list[Value]
    which: np.ndarray
    index: np.ndarray


@dataclass(eq=False, repr=False)
class Map(Value):
    """An operation of `operations.py` on the numbers at one place of each argument [size]."""

    op: str
    args: list[Value]
    param: Any = None  # of "lookup": the value to look up in


@dataclass(eq=False, repr=False)
class Fold(Value):
    """Rows of terms, [size, terms], each row made one number: a sum, or a greatest."""

    op: str
    arg: Value
    terms: int
    shared: bool = False  # whether lanes share each row: see `lanes.py`


@dataclass(eq=False, repr=False)
class Step:
    """What is no expression: it reads values, and writes held ones."""

    block: Block
    reads: list[Value]
    writes: list[Held]


@dataclass(eq=False, repr=False)
class Loop(Step):
    """Rounds of a body. `reads` are what `writes`, the carry, starts from."""

    inner: Block
    results: list[Value]  # what a round puts into the carry
    rounds: int | None  # None: as long as `going` is true
    test: Block | None = None
    going: Value | None = None


@dataclass(eq=False, repr=False)
class Choice(Step):
    """One branch of several: that with the number in `reads`, or the nearest there is."""

    branches: list[Block]
    results: list[list[Value]]


@dataclass(eq=False, repr=False)
class Linear(Step):
    """A Cholesky factor of [n, n], or the solution of a triangular system, in place."""

    op: str  # "cholesky" or "solve"
    lower: bool = True  # of a solve: which half of the matrix is read,
    transposed: bool = False  # and whether it is read as its transpose


def home(value: Value) -> Value:
    """Returns the value in whose memory a value stands."""
    return value.home if isinstance(value, Held) and value.home else value


def kind_of(dtype: Any) -> str:
    """Returns the kind of a dtype; NoRuleError if a kernel has none for it."""
    for kind, known in DTYPES.items():
        if dtype == known:
            return kind
    raise NoRuleError(f"numbers of {dtype}")
