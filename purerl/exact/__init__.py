"""Makes a JAX function bit-exact: the same bits in every run on one kind of device.

Usable by itself, with plain MJX: `exact.rewrite(step)`; see docs/exact.md.

What belongs here: whatever rewrites a traced function or sets what XLA chooses, for any function,
without knowledge of reinforcement learning or of this library's engines.

What it may import: JAX and numpy, nothing else of purerl.

Where to start reading: `rewriting.py` (the public function), `walk.py` (how a trace is run again
with equations replaced), then the two sets of rules: `order.py` with `scatters.py` (the promise)
and `fuse.py` (the optimisation). `xla_flags.py` stands alone.
"""

import importlib
from typing import Any

# Imported when they are asked for: `set_xla_flags` has to be called before JAX starts.
_PUBLIC = {
    "rewrite": "rewriting",
    "unordered_sums": "order",
    "unordered_in": "order",
    "ScatterSum": "order",
    "set_xla_flags": "xla_flags",
    "how_chosen": "xla_flags",
    "equal_passes": "xla_flags",
}
__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"purerl.exact has no {name!r}; it has {', '.join(__all__)}.")
    return getattr(importlib.import_module(f"{__name__}.{_PUBLIC[name]}"), name)
