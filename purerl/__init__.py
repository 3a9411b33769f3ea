"""PPO on MuJoCo MJX: readable in an afternoon, reproducible to the last bit.

The names in `__init__.pyi` are the whole interface: `train` and `load`, what an experiment, an
environment and a network are made of, and the algorithm itself, `init` and `update`. Whatever else
is in this package may move.

A name is imported when it is first used: `import purerl` does not start JAX.
"""

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

__version__ = "0.2.0"


def listed(file: str) -> dict[str, str]:
    """Returns what the stub beside an `__init__.py` imports, name -> module, importing nothing."""
    nodes = ast.parse(Path(file).with_suffix(".pyi").read_bytes()).body
    lines = [node for node in nodes if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(line.module) for line in lines for alias in line.names}


def lazy(
    package: str, file: str
) -> tuple[dict[str, str], Callable[[str], Any], Callable[[], list[str]]]:
    """Returns what makes a package import its public names when they are used.

    Args:
      package: its name.
      file: its `__init__.py`, which has a stub beside it.

    Returns:
      Its names with their modules, and its `__getattr__` and `__dir__`.
    """
    homes = listed(file)

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"{package} has no name {name!r}: {what_to_write(name, package)}.")
        home = vars(importlib.import_module(homes[name]))
        # As `from home import name` does: what is no name of the module may be a module in it.
        return home[name] if name in home else importlib.import_module(f"{homes[name]}.{name}")

    return homes, get, lambda: sorted(homes)


HOMES, __getattr__, __dir__ = lazy(__name__, __file__)
__all__ = sorted(HOMES)


def what_to_write(name: str, package: str = __name__) -> str:
    """Returns the line to write for a name that was looked for in vain, or the names there are."""
    import difflib

    known = {public.lower(): public for public in sys.modules[package].__all__}
    near = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.7)
    if near:
        return f"write `from {package} import {known[near[0]]}`"
    return f"the names to import from {package} are {', '.join(known.values())}"


def how_to_install(extra: str) -> str:
    """Returns the line to paste for an extra: at the tested versions where there is a clone."""
    in_clone = (Path(__file__).resolve().parents[1] / "constraints.txt").is_file()
    words = f"-c constraints.txt -e '.[{extra}]'" if in_clone else f"'purerl[{extra}]'"
    return f"python -m pip install {words}"
