"""MJX without Warp, of which engine `jax` has no use."""

import contextlib
import sys
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def without_warp() -> Iterator[None]:
    """MJX that is imported in it does not find Warp: all of Warp takes 3 s of a core.

    Engine `warp` imports Warp by itself. Who wants MJX's own `impl="warp"`, too, imports
    `mujoco.mjx` first.
    """
    modules: dict[str, Any] = sys.modules
    hidden = modules.setdefault("warp", None) is None
    try:
        yield
    finally:
        if hidden:
            del modules["warp"]
