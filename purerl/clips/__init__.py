"""Clips: recorded motion as arrays, fitted to a body, checked, and drawn from by weights.

May import: core, physics, machine, experiment, report. Read: `records.py`, then `files.py` and
`body.py`: what a file holds, and how it becomes a body's. `sampling.py` is what an environment
calls. docs/howto/clips.md shows all of it.
"""

import importlib
from typing import Any

import purerl

HOMES = purerl.listed(__file__)
__all__ = sorted(HOMES)


def __getattr__(name: str) -> Any:
    """Imports a public name when it is first used."""
    if name not in HOMES:
        raise AttributeError(f"purerl.clips has no {name!r}; it has {', '.join(__all__)}.")
    return getattr(importlib.import_module(HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
