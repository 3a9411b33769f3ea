"""The file of an experiment that is given as an object: found, or written.

A run keeps a file that rebuilds its experiment, so that its folder alone is enough later.
"""

import dataclasses
import enum
import functools
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import purerl
from purerl.core.errors import UserError
from purerl.runs.experiment import (
    FOUND,
    Experiment,
    Source,
    load,
    settings,
    to_json,
)

NAME = "experiment"  # names the folder under runs/ when no file does


@contextmanager
def source_of(experiment: Experiment) -> Iterator[Source]:
    """Yields the file that this experiment was found in, or one written for it, which then goes.

    Raises:
      UserError: a builder or a class cannot be imported, or a value cannot be written down.
    """
    for source in FOUND:
        if source.experiment == experiment:
            yield source
            return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{NAME}.py"
        path.write_text(source_text(experiment))
        if to_json(settings(load(path).experiment)) != to_json(settings(experiment)):
            raise UserError(
                f"A file cannot rebuild {experiment}: the copy differs. Put the experiment into a "
                ".py file, and give that file's path."
            )
        yield Source(experiment, NAME, path)


def source_text(experiment: Experiment) -> str:
    """Returns a Python file that rebuilds an experiment."""
    to_json(settings(experiment))  # names what no file can hold
    modules = {"purerl"}
    fields = {f.name: getattr(experiment, f.name) for f in dataclasses.fields(experiment)}
    lines = [f"    {name}={_text(value, name, modules)},\n" for name, value in fields.items()]
    imports = [f"import {module}\n" for module in sorted(modules)]
    about = '"""An experiment, written by purerl.train."""'
    return f"{about}\n\n{''.join(imports)}\nexperiment = purerl.Experiment(\n{''.join(lines)})\n"


def _text(value: Any, path: str, modules: set[str]) -> str:
    """Returns the expression that makes a value; adds to `modules` what it needs."""
    inside = functools.partial(_text, modules=modules)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        parts = [(f.name, getattr(value, f.name)) for f in dataclasses.fields(value) if f.init]
        inner = ", ".join(f"{name}={inside(part, f'{path}.{name}')}" for name, part in parts)
        return f"{_importable(type(value), path, modules)}({inner})"
    if isinstance(value, enum.Enum):
        return f"{_importable(type(value), path, modules)}.{value.name}"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{k!r}: {inside(v, path)}' for k, v in value.items())}}}"
    if isinstance(value, list | tuple):
        inner = ", ".join(inside(part, path) for part in value)
        one = "," if len(value) == 1 else ""
        return f"[{inner}]" if isinstance(value, list) else f"({inner}{one})"
    if isinstance(value, Path):
        return f"{_importable(Path, path, modules)}({str(value)!r})"
    if isinstance(value, float):
        text = float.__repr__(value)
        return text if value - value == 0.0 else f"float({text!r})"  # else inf, nan
    return _importable(value, path, modules) if callable(value) else repr(value)


def _importable(thing: Any, path: str, modules: set[str]) -> str:
    """Returns the full name of a function or class, by the front door where it is in that."""
    module, name = str(getattr(thing, "__module__", "")), getattr(thing, "__qualname__", "?")
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    code = [getattr(x, "__code__", None) for x in (found, thing)]  # a module may be loaded twice
    if module == "__main__" or found is None or code[0] != code[1]:
        raise UserError(
            f"{path} is {name} of {module}, which a run's file cannot import: put it into a .py "
            "file of its own and import it from there, or give train that file's path."
        )
    public = {purerl.HOMES[n]: n for n in purerl.__all__ if purerl.HOMES[n].endswith(f".{n}")}
    if purerl.HOMES.get(name) == module:
        return f"purerl.{name}"
    if module in public:
        return f"purerl.{public[module]}.{name}"
    modules.add(module)
    return f"{module}.{name}"
