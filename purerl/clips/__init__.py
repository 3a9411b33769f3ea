"""Clips: recorded motion as arrays, fitted to a body, checked, and drawn from by weights.

May import: core, physics, machine, experiment, report. Read: `records.py`, then `files.py` and
`body.py`: what a file holds, and how it becomes a body's. `sampling.py` is what an environment
calls; `episodes.py` writes what `record` recorded. docs/howto/clips.md shows all of it.
"""

import purerl

HOMES, __getattr__, __dir__ = purerl.lazy(__name__, __file__)
__all__ = sorted(HOMES)
