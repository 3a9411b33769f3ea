"""A policy that `python -m purerl.export RUN` took away, in numpy alone: copy this file."""

import numpy as np


def sigmoid(x):
    """Without overflow."""
    return 0.5 + 0.5 * np.tanh(0.5 * x)


ACTIVATIONS = {
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
    "relu": lambda x: np.maximum(x, 0),
    "swish": lambda x: x * sigmoid(x),
    "tanh": np.tanh,
}


class Policy:
    """`policy(observation)`; call `reset()` before each episode."""

    def __init__(self, file):
        """Reads a file."""
        self.arrays = dict(np.load(file))
        self.reset()

    def reset(self):
        """Forgets."""
        self.h = self.c = np.zeros(self.arrays["memory_size"], np.float32)

    def _dense(self, name, x):
        return x @ self.arrays[f"{name}/kernel"] + self.arrays.get(f"{name}/bias", 0)

    def _gru(self, x):
        r, z = (sigmoid(self._dense(f"i{k}", x) + self._dense(f"h{k}", self.h)) for k in "rz")
        new = np.tanh(self._dense("in", x) + r * self._dense("hn", self.h))
        self.h = (1 - z) * new + z * self.h

    def _lstm(self, x):
        i, f, g, o = (self._dense(f"i{k}", x) + self._dense(f"h{k}", self.h) for k in "ifgo")
        self.c = sigmoid(f) * self.c + sigmoid(i) * np.tanh(g)
        self.h = sigmoid(o) * np.tanh(self.c)

    def __call__(self, observation):
        """Returns the action [..., A] in [-1, 1] of an observation [..., O]."""
        a = self.arrays
        x = (np.asarray(observation, np.float32) - a["mean"]) / a["std"]
        x = np.clip(x, -a["clip"], a["clip"])
        for layer in range(a["layers"]):
            x = ACTIVATIONS[str(a["activation"])](self._dense(f"layer{layer}", x))
        if a["cell"]:
            getattr(self, f"_{a['cell']}")(x)
            x = self.h
        return np.tanh(self._dense("loc", x))

    def control(self, observation):
        """Returns the action as MuJoCo's `data.ctrl`, [..., A], over each actuator's range."""
        low, high = self.arrays["control_range"].T
        return low + 0.5 * (self(observation) + 1) * (high - low)
