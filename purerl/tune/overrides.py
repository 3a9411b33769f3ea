"""Settings as the words of a command line that make them; pure."""

import dataclasses
import enum
import shlex
from typing import Any

from purerl.experiment.definition import Experiment
from purerl.experiment.settings_json import settings_of


def option_words(name: str, default: Any, value: Any) -> list[str]:
    """Returns the words that turn a setting's default into `value`; [] where they are equal.

    >>> option_words("env.gap_length", (0.1, 0.2), (0.1, 0.4))
    ['--env.gap-length', '0.1', '0.4']
    >>> option_words("env.observe_place", True, False)
    ['--env.no-observe-place']
    """
    if dataclasses.is_dataclass(value) and type(value) is type(default):
        inner = [(f"{name}.{n}", getattr(default, n), v) for n, v in settings_of(value).items()]
        return [word for each in inner for word in option_words(*each)]
    if value == default and type(value) is type(default):
        return []
    option = name.replace("_", "-")
    if isinstance(default, bool) and isinstance(value, bool):
        path, dot, last = option.rpartition(".")
        return [f"--{path}{dot}{last if value else f'no-{last}'}"]
    parts = value if isinstance(value, list | tuple) else [value]
    texts = [part.name if isinstance(part, enum.Enum) else _text(part) for part in parts]
    return [f"--{option}", *texts]


def _text(value: Any) -> str:
    """Returns a value as a word; a slider's number without the noise of its last bits."""
    if not isinstance(value, float):
        return str(value)
    short = f"{value:.6g}"
    return repr(float(short)) if abs(float(short) - value) <= 1e-9 * abs(value) else repr(value)


def train_command(name: str, written: Experiment, chosen: Experiment, env: Any) -> str:
    """Returns the command that trains these options of the environment.

    Args:
      name: of the experiment, or its file.
      written: the experiment as its file has it.
      chosen: the run's, whose other settings are kept.
      env: the environment's options.
    """
    parts = {n: v for n, v in settings_of(chosen).items() if dataclasses.is_dataclass(v)}
    parts["env"] = env
    words = [w for n, v in parts.items() for w in option_words(n, getattr(written, n), v)]
    return shlex.join(["python", "-m", "purerl.run", name, *words])
