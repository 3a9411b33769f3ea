"""Makes a JAX function bit-exact: the same bits in every run on one kind of device.

It serves anybody with plain MJX: `exact.rewrite(mjx.step)`; see docs/howto/exact.md.

What belongs here: code that rewrites a traced function, and the choices of XLA that change bits.
May import: nothing. Read: `rewriting.py` (the public function), `walk.py` (how a trace is run again
with equations replaced), then the two sets of rules: `order.py` with `scatters.py`, the promise,
and `fuse.py`, the optimisation. `portable.py` has the rules for a CPU. `xla_flags.py` stands alone.
`kernel/` makes a function one kernel, and has its own README.
"""

import purerl

# Imported when they are asked for: `set_xla_flags` has to be called before JAX starts.
HOMES, __getattr__, __dir__ = purerl.lazy(__name__, __file__)
__all__ = sorted(HOMES)
