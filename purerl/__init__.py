"""PPO on MuJoCo MJX: readable in an afternoon, reproducible to the last bit.

The names in `__init__.pyi` are the whole interface: `train` and `load`, what an experiment, an
environment and a network are made of, and the algorithm itself, `init` and `update`. Whatever else
is in this package may move.

A name is imported when it is first used: `import purerl` does not start JAX.
"""

import ast
import importlib
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
    """Returns what makes a room import its public names when they are first used.

    Args:
      package: the room's name.
      file: its `__init__.py`, which has a stub beside it.

    Returns:
      Its names with their modules, and the room's `__getattr__` and `__dir__`.
    """
    homes = listed(file)

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"{package} has no {name!r}; it has {', '.join(sorted(homes))}.")
        return getattr(importlib.import_module(homes[name]), name)

    return homes, get, lambda: sorted(homes)


HOMES = listed(__file__)
__all__ = sorted(HOMES)


def __getattr__(name: str) -> Any:
    """Imports a public name when it is first used."""
    if name not in HOMES:
        raise AttributeError(f"purerl has no name {name!r}: {what_to_write(name)}.")
    home = HOMES[name]
    if home == __name__:
        return importlib.import_module(f"{home}.{name}")
    # As `from home import name` does: what is no name of the module may be a module in it.
    found = getattr(__import__(home, fromlist=[name]), name)
    return globals().setdefault(name, found)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def what_to_write(name: str) -> str:
    """Returns the line to write for a name that was looked for in vain, or the names there are."""
    import difflib

    known = {public.lower(): public for public in __all__}
    near = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.7)
    if near:
        return f"write `from purerl import {known[near[0]]}`"
    return f"the names to import from purerl are {', '.join(__all__)}"


def how_to_install(extra: str) -> str:
    """Returns the line to paste for an extra: at the tested versions where there is a clone."""
    in_clone = (Path(__file__).resolve().parents[1] / "constraints.txt").is_file()
    words = f"-c constraints.txt -e '.[{extra}]'" if in_clone else f"'purerl[{extra}]'"
    return f"python -m pip install {words}"
