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

    def _layers(self, name, number, x):
        for i in range(number):
            x = ACTIVATIONS[str(self.arrays["activation"])](self._dense(f"{name}{i}", x))
        return x

    def _gru(self, x):
        r, z = (sigmoid(self._dense(f"i{k}", x) + self._dense(f"h{k}", self.h)) for k in "rz")
        new = np.tanh(self._dense("in", x) + r * self._dense("hn", self.h))
        self.h = (1 - z) * new + z * self.h

    def _lstm(self, x):
        i, f, g, o = (self._dense(f"i{k}", x) + self._dense(f"h{k}", self.h) for k in "ifgo")
        self.c = sigmoid(f) * self.c + sigmoid(i) * np.tanh(g)
        self.h = sigmoid(o) * np.tanh(self.c)

    def _see(self, pictures):
        """Yields the features [..., F] of each eye's pictures, of uint8 [..., E, H, W]."""
        a = self.arrays
        for eye in range(pictures.shape[-3]):
            name = f"eye{eye % a['encoders']}"
            x = pictures[..., eye, :, :, None] / np.float32(127.5) - 1
            for i, (kernel, stride) in enumerate(a["windows"]):
                x = np.lib.stride_tricks.sliding_window_view(x, (kernel, kernel), (-3, -2))
                x = np.moveaxis(x[..., ::stride, ::stride, :, :, :], -3, -1)
                x = np.maximum(self._dense(f"{name}/Dense_{i}", x.reshape(*x.shape[:-3], -1)), 0)
            x = self._dense(f"{name}/Dense_{len(a['windows'])}", x.reshape(*x.shape[:-3], -1))
            x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
            yield np.maximum(x * a[f"{name}/LayerNorm_0/scale"] + a[f"{name}/LayerNorm_0/bias"], 0)

    def __call__(self, observation):
        """Returns the action [..., A] in [-1, 1] of an observation [..., O], or a dict with it."""
        a = self.arrays
        parts = observation if isinstance(observation, dict) else {"policy": observation}
        x = (np.asarray(parts["policy"], np.float32) - a["mean"]) / a["std"]
        x = np.clip(x, -a["clip"], a["clip"])
        if a["encoders"]:
            x = np.concatenate([x, *self._see(np.asarray(parts["eyes"]))], -1)
        if a["cell"]:
            getattr(self, f"_{a['cell']}")(self._layers("before", a["before"], x))
            x = np.concatenate([x, self.h], -1)
        return np.tanh(self._dense("loc", self._layers("layer", a["layers"], x)))

    def control(self, observation):
        """Returns the action as MuJoCo's `data.ctrl`, [..., A], over each actuator's range."""
        low, high = self.arrays["control_range"].T
        return low + 0.5 * (self(observation) + 1) * (high - low)
