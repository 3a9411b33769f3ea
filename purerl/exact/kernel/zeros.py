"""Which numbers are known to be 0 before a kernel runs: MJX multiplies by masks of the model.

Most of a Jacobian is such zeros: a contact moves with the joints above its two bodies alone.
"""

import numpy as np

from purerl.exact.kernel.values import Const, Fold, Map, Value, View

# What gives 0 of nothing but zeros; a select's zeros are of its sides.
OF_ZEROS = {"abs", "add", "convert_element_type", "copy", "max", "min", "neg", "select_n", "sign"}
OF_ZEROS |= {"sin", "sqrt", "square", "sub", "tan"}


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
            return self.of(value.arg).reshape(-1, value.terms).min(1)
        if isinstance(value, Map) and value.op == "mul":
            return self.of(value.args[0]) | self.of(value.args[1])
        if isinstance(value, Map) and value.op in OF_ZEROS:
            sides = value.args[1:] if value.op == "select_n" else value.args
            return np.stack([self.of(side) for side in sides]).min(0)  # all of them
        return np.zeros(value.size, bool)
