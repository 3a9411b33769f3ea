"""An experiment's settings as JSON values, and back."""

import dataclasses
import enum
import inspect
import reprlib
from pathlib import Path
from typing import Any

from purerl.core.errors import UserError, one_line, unknown_name
from purerl.experiment.definition import BUILDERS
from purerl.experiment.kinds import fits, hints


def settings_of(value: Any) -> dict[str, Any]:
    """Returns the fields of an experiment, or of a dataclass in it, but not its builders."""
    return {
        field.name: getattr(value, field.name)
        for field in dataclasses.fields(value)
        if field.init and field.name not in BUILDERS
    }


def has_settings(value: Any) -> bool:
    """Tells whether a value is a dataclass's: settings of one part of an experiment."""
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def to_json(value: Any, path: str = "") -> Any:
    """Turns settings into JSON values; UserError names a field that JSON cannot hold."""
    if has_settings(value):
        value = settings_of(value)
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {key: to_json(v, _join(path, key)) for key, v in value.items()}
    if isinstance(value, tuple | list):
        return [to_json(v, f"{path}[{i}]") for i, v in enumerate(value)]
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise UserError(
        f"{path} is a {type(value).__name__}, which config.json cannot hold. Settings are numbers, "
        "strings, None, and tuples, dicts and dataclasses of them; build the rest in build_env."
    )


def from_json(template: Any, values: Any, path: str = "") -> Any:
    """Returns `template` with JSON values in place of its own, the inverse of `to_json`.

    Raises:
      UserError: a field is missing or unknown: the code is not the one that wrote the values.
    """
    if has_settings(template):
        known, kinds = settings_of(template), hints(type(template))
        _check_names(list(known), values, path)
        for name, value in known.items():
            kind, given = kinds.get(name, Any), values[name]
            if not fits(kind, given) and given != (like := to_json(value)):
                must = f"{inspect.formatannotation(kind)}, such as {like!r}"
                said = f"{_join(path, name)} is {reprlib.repr(given)}; it must be {must}."
                raise UserError(f"config.json: {said}")
        try:
            read = {n: from_json(value, values[n], _join(path, n)) for n, value in known.items()}
            return dataclasses.replace(template, **read)
        except UserError:
            raise
        except Exception as error:  # a rule of the dataclass, or of its author
            raise UserError(f"config.json: {path or 'experiment'}: {one_line(error)}") from error
    if isinstance(template, enum.Enum):
        return type(template)[values]
    if isinstance(template, Path):
        return Path(values)
    if isinstance(values, dict):
        like = template if isinstance(template, dict) else {}
        return {k: from_json(like.get(k), v, _join(path, k)) for k, v in values.items()}
    if isinstance(values, list):
        first = list(template) if isinstance(template, list | tuple) and template else [None]
        first += first[-1:] * (len(values) - len(first))  # what is longer goes on like the last
        inner = [from_json(t, v, f"{path}[]") for t, v in zip(first, values, strict=False)]
        return inner if isinstance(template, list) else tuple(inner)
    return values


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _check_names(names: list[str], values: Any, path: str) -> None:
    if not isinstance(values, dict):
        raise UserError(f"The settings of {path} are {values!r}; they must be {{name: value}}.")
    for name in sorted(set(names).symmetric_difference(values)):
        if name in names:
            raise UserError(f"config.json lacks {_join(path, name)}, which the experiment has.")
        what = unknown_name("setting", _join(path, name), [_join(path, n) for n in names])
        raise UserError(f"config.json: {what} The code may be of another version.")
