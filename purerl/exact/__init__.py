"""Makes a JAX function bit-exact: the same bits in every run on one kind of device.

It serves anybody with plain MJX: `exact.rewrite(mjx.step)`; see docs/howto/exact.md.

What belongs here: code that rewrites a traced function, and the choices of XLA that change bits.
May import: nothing. Read: `rewriting.py` (the public function), `walk.py` (how a trace is run again
with equations replaced), then the two sets of rules: `order.py` with `scatters.py`, the promise,
and `fuse.py`, the optimisation. `portable.py` has the rules for a CPU. `xla_flags.py` stands alone.
"""

import importlib
from typing import Any

# Imported when they are asked for: `set_xla_flags` has to be called before JAX starts.
_PUBLIC = dict.fromkeys(("unordered_sums", "unordered_in", "ScatterSum"), "order")
_PUBLIC |= dict.fromkeys(("set_xla_flags", "how_chosen", "equal_passes"), "xla_flags")
_PUBLIC |= dict.fromkeys(("set_portable_flags", "is_portable"), "xla_flags")
_PUBLIC |= {"rewrite": "rewriting", "without_libraries": "portable"}
__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"purerl.exact has no {name!r}; it has {', '.join(__all__)}.")
    return getattr(importlib.import_module(f"{__name__}.{_PUBLIC[name]}"), name)


def __dir__() -> list[str]:
    """Lists the public names."""
    return __all__
