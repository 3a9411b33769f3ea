"""The numbers in an environment's options: what has a slider, from where to where; pure."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

Place = tuple[str | int, ...]  # such as ("randomization", "friction", 1)


def numbers_of(options: Any, place: Place = ()) -> dict[Place, int | float]:
    """Returns every whole number and float of a dataclass, of dataclasses and tuples in it too.

    >>> numbers_of(Corridor(gap=(0.1, 0.2), name="long", steps=5))
    {('gap', 0): 0.1, ('gap', 1): 0.2, ('steps',): 5}
    """
    if isinstance(options, int | float) and not isinstance(options, bool):
        return {place: options}
    inner: Any = ()
    if dataclasses.is_dataclass(options):
        inner = [(f.name, getattr(options, f.name)) for f in dataclasses.fields(options) if f.init]
    elif isinstance(options, tuple):
        inner = enumerate(options)
    found: dict[Place, int | float] = {}
    for name, value in inner:
        found |= numbers_of(value, (*place, name))
    return found


def replaced(options: Any, values: Mapping[Place, Any]) -> Any:
    """Returns options with other numbers, place -> number; rules of a dataclass see all of them.

    Raises what a rule of the dataclasses raises.
    """
    if () in values:
        return values[()]
    inside: dict[str | int, dict[Place, Any]] = {}
    for (name, *rest), value in values.items():
        inside.setdefault(name, {})[tuple(rest)] = value
    if isinstance(options, tuple):
        parts = [replaced(part, inside.get(i, {})) for i, part in enumerate(options)]
        return type(options)(*parts) if hasattr(options, "_fields") else tuple(parts)
    if isinstance(options, dict):
        return {name: replaced(part, inside.get(name, {})) for name, part in options.items()}
    changed = {str(n): replaced(getattr(options, str(n)), part) for n, part in inside.items()}
    return dataclasses.replace(options, **changed) if changed else options


def bounds(value: int | float) -> tuple[float, float, float]:
    """Returns a slider's least and greatest value and its step, from a number's magnitude.

    From 0 to four times the number, in at least 100 round steps; around 0 from -1 to 1.

    >>> bounds(5.0), bounds(0.0), bounds(3), bounds(-2)
    ((0.0, 20.0, 0.1), (-1.0, 1.0, 0.01), (0, 12, 1), (-8, 0, 1))
    """
    if isinstance(value, int):
        last = 4 * value or 10
        return min(0, last), max(0, last), max(1, int(_step(abs(last))))
    if value == 0.0 or not math.isfinite(value):
        return -1.0, 1.0, 0.01
    step = _step(4 * abs(value))
    end = math.copysign(math.ceil(4 * abs(value) / step - 1e-9) * step, value)
    return min(0.0, end), max(0.0, end), step


def _step(width: float) -> float:
    """Returns the greatest of 1, 2, 5 times a power of ten of which 100 fit into `width`."""
    digits, power = f"{width / 100:e}".split("e")
    return float(f"{max(x for x in (1, 2, 5) if x <= float(digits))}e{power}")


def label(place: Place) -> str:
    """Returns a place as a person reads it.

    >>> label(("randomization", "friction", 1))
    'randomization.friction[1]'
    """
    return "".join(f"[{x}]" if isinstance(x, int) else f".{x}" for x in place).removeprefix(".")
