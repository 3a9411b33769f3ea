"""Does a value fit a setting, a name one that there is? What a folder says may be a stranger's."""

import dataclasses
import enum
import inspect
import re
import types
import typing
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from purerl.experiment import other_trainers


def hints(kind: type) -> dict[str, Any]:
    """Returns the annotations of a dataclass's fields; {} where they name what is not there."""
    try:
        return typing.get_type_hints(kind)
    except Exception:  # it evaluates text: any error
        return {}


def fits(hint: Any, value: Any, exact: bool = False) -> bool:
    """Tells whether a value, of JSON or of Python, is one for `hint`; True for hints unknown here.

    Args:
      hint: the annotation.
      value: a setting, or how JSON holds it.
      exact: whether a whole number must be one: no True, and no 2.0.

    >>> fits(tuple[int, ...], [64, 64]), fits(tuple[int, ...], 64), fits(float | None, "fast")
    (True, False, False)
    """
    origin, inner = get_origin(hint) or hint, get_args(hint)
    value = value.name if isinstance(value, enum.Enum) else value  # so JSON holds it
    if origin in (Union, types.UnionType):
        return any(fits(one, value, exact) for one in inner)
    if origin is Literal:
        return value in [getattr(one, "name", one) for one in inner]
    if origin in (tuple, list):
        every = origin is list or inner[1:] == (...,)
        wanted = inner[:1] * len(value) if every and isinstance(value, tuple | list) else inner
        return isinstance(value, tuple | list) and (not inner or _all_fit(wanted, value, exact))
    if origin is dict:
        values = list(value.values()) if isinstance(value, dict) else []
        wanted = inner[1:] * len(values)
        return isinstance(value, dict) and (not inner or _all_fit(wanted, values, exact))
    if origin is types.NoneType:
        return value is None
    if not isinstance(origin, type):
        return True
    if issubclass(origin, enum.Enum):
        return isinstance(value, str) and value in origin.__members__
    if issubclass(origin, int | float):  # a whole number may stand for a float, true for 1
        return _is_number(origin, value) if exact else isinstance(value, int | float)
    return not issubclass(origin, str | Path) or isinstance(value, str | origin)


def _is_number(kind: type, value: Any) -> bool:
    if kind is bool:
        return isinstance(value, bool) or value in (0, 1)
    kinds = int | float if issubclass(kind, float) else int
    return isinstance(value, kinds) and not isinstance(value, bool)


def _all_fit(hints: Any, values: Any, exact: bool) -> bool:
    return len(hints) == len(values) and all(map(fits, hints, values, [exact] * len(values)))


WORDS = {int: "a whole number", float: "a number", bool: "True or False", str: "a text"}


def wrong_value(record: Any, path: str = "") -> str:
    """Returns which field of a dataclass, or of one in it, is not of its annotated kind, or "".

    Python checks no annotation, and 2.5 epochs or True environments would train.

    >>> from purerl import Config
    >>> wrong_value(Config(num_steps=10_000, num_epochs=2.5))
    'num_epochs is 2.5; it must be a whole number.'
    """
    own = type(record).__module__.startswith("purerl.")  # ours say where None may stand
    for name in _without_annotation(type(record)):
        return f"{path}{name} has no annotation, so it is no setting: write `{name}: float`, say."
    for name, hint in hints(type(record)).items():
        value, where = getattr(record, name, None), f"{path}{name}"
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            if wrong := wrong_value(value, f"{where}."):
                return wrong
        elif (value is not None or own) and not fits(hint, value, exact=True):
            return f"{where} is {value!r}; it must be {_in_words(hint)}."
    return ""


def _without_annotation(kind: type) -> list[str]:
    """Returns what looks like a field of a dataclass, but is none; a constant is in capitals."""
    annotated = inspect.get_annotations(kind)
    return [
        name
        for name, value in vars(kind).items()
        if isinstance(value, bool | int | float | str | tuple)
        and not (name.startswith("_") or name.isupper() or name in annotated)
    ]


def _in_words(hint: Any) -> str:
    inner = get_args(hint)
    if get_origin(hint) is Literal:
        return " or ".join(map(repr, inner))
    if get_origin(hint) is tuple and inner[1:] == (...,):
        return f"a tuple, each part {_in_words(inner[0])}"
    return WORDS.get(hint) or inspect.formatannotation(hint)


def suggest_field(error: str, *kinds: type) -> str:
    """Returns a hint where one of these dataclasses was called with a name that it lacks, or ""."""
    found = re.search(r"(\w+)\.__init__\(\) got an unexpected keyword argument '(\w+)'", error)
    if "missing" in error and "'action_size'" in error:
        return "; give the function itself: build_network=networks.mlp"
    known = {kind.__name__: dataclasses.fields(kind) for kind in kinds}
    if not found or found[1] not in known:
        return ""
    names = [field.name for field in known[found[1]]]
    near = other_trainers.suggest(found[2], names)
    return f"; {near[0].lower()}{near[1:]}" if near else f"; there are: {', '.join(names)}"
