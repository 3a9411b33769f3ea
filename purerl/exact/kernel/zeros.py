"""Which numbers are known to be 0 before a kernel runs: MJX multiplies by masks of the model.

Most of a Jacobian is such zeros: a contact moves with the joints above its two bodies alone.
"""

import numpy as np

from purerl.exact.kernel.values import Const, Fold, Map, Value, View

# What gives 0 of nothing but zeros. A select's zeros are of both its sides, a product's of one.
ZERO_OF_ZEROS = """abs add add_any and convert_element_type copy max min mul neg or select_n sign
sin sqrt square sub tan""".split()  # noqa: SIM905


class Zeros:
    """Finds known zeros, each value's once."""

    def __init__(self) -> None:
        """Begins with none."""
        self._known: dict[Value, np.ndarray] = {}

    def of(self, value: Value) -> np.ndarray:
        """Returns whether each number [size] is known to be 0."""
        if value not in self._known:
            self._known[value] = self._found(value)
        return self._known[value]

    def _found(self, value: Value) -> np.ndarray:
        if isinstance(value, Const):
            return value.array.reshape(-1) == 0
        if isinstance(value, View):
            found = np.zeros(value.size, bool)
            for number, source in enumerate(value.sources):
                here = value.which == number
                found[here] = self.of(source)[value.index[here]]
            return found
        if isinstance(value, Fold) and value.op == "add":
            return self.of(value.arg).reshape(-1, value.terms).all(1)
        if isinstance(value, Map) and value.op in ZERO_OF_ZEROS:
            args = value.args[1:] if value.op == "select_n" else value.args
            join = np.any if value.op == "mul" else np.all
            return join([self.of(arg) for arg in args], 0)
        return np.zeros(value.size, bool)
