"""Numpy's index maps as C: a line through them, digits of the loop's number, or a table."""

import numpy as np

# Shorter maps are read from a table: that is shorter than an expression of two terms.
LONG = 33
MOST_DIGITS = 3


class Tables:
    """Numbers that all environments read: places (16 bits), and constants (32 bits)."""

    def __init__(self) -> None:
        """Begins with empty tables."""
        self.places: list[np.ndarray] = []
        self.constants: list[np.ndarray] = []
        self._known: dict[tuple[str, bytes], int] = {}
        self._length = {"T": 0, "C": 0}

    def place(self, index: np.ndarray) -> int:
        """Returns where a map of places begins in the table T."""
        return self._put("T", self.places, index.astype(np.uint16))

    def constant(self, numbers: np.ndarray, kind: str) -> int:
        """Returns where an array of constants begins in the table C."""
        memory = numbers.astype(np.float32 if kind == "f" else np.int32)
        return self._put("C", self.constants, np.ascontiguousarray(memory).view(np.uint32))

    def _put(self, name: str, into: list[np.ndarray], array: np.ndarray) -> int:
        array = array.reshape(-1)
        key = name, array.tobytes()
        if key not in self._known:
            self._known[key] = self._length[name]
            self._length[name] += array.size
            into.append(array)
        return self._known[key]


def text(tables: Tables, index: np.ndarray, number: str = "i") -> str:
    """Returns C for `index[number]`, where `number` is C for a whole number.

    Divisions cost more than a look into a table, so they are made of long maps alone.
    """
    line = as_line(index)
    if line is not None:
        return _line(*line, number)
    digits = _digits(index, number, MOST_DIGITS) if len(index) >= LONG else None
    least = int(index.min())  # maps of which one is the other and a constant share a table
    return digits or f"T[{tables.place(index - least)}+{number}]" + (f"+{least}" if least else "")


def as_line(index: np.ndarray) -> tuple[int, int] | None:
    """Returns (step, start) if the map is a line, else None."""
    steps = np.diff(index)
    if not len(steps):
        return 0, int(index[0])
    return (int(steps[0]), int(index[0])) if (steps == steps[0]).all() else None


def _line(step: int, start: int, number: str) -> str:
    if not step:
        return str(start)
    return f"{start}+{number}" if step == 1 else f"{start}+{step}*({number})"


def _digits(index: np.ndarray, number: str, most: int) -> str | None:
    """Returns the map as a sum of multiples of the number's digits; None if there is no such."""
    line = as_line(index)
    if line is not None:
        return _line(*line, f"({number})")
    steps = np.diff(index)
    period = int(np.flatnonzero(steps != steps[0])[0]) + 1
    heads, place = index[::period], np.arange(len(index))
    if most == 1 or (index != heads[place // period] + steps[0] * (place % period)).any():
        return None
    high = _digits(heads, f"({number})/{period}", most - 1)
    low = f"+{steps[0]}*(({number})%{period})" if steps[0] else ""
    return None if high is None else high + low
