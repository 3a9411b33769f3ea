"""The points of a sweep: settings as words of `python -m purerl.run`, checked before it begins."""

import dataclasses
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args

import tyro

from purerl.core.errors import UserError, one_line
from purerl.experiment import definition, kinds, loading, other_trainers, settings_json
from purerl.experiment.command_line import WORDS, parse
from purerl.experiment.options import RunOptions
from purerl.tune import overrides
from purerl.tune.option_numbers import Place, replaced
from purerl.tune.sweep.scheduler import Job
from purerl.tune.sweep.spaces import Space, Values, parse_space


class Point(NamedTuple):
    """Settings that are trained with several seeds."""

    number: int
    values: Values

    @property
    def name(self) -> str:
        """The name of its runs."""
        return f"p{self.number:04d}"


class Base(NamedTuple):
    """What all points have in common."""

    experiment: str  # as the user named it
    source: loading.Source  # of the experiment
    chosen: definition.Experiment  # with the settings that all points share
    words: tuple[str, ...]  # of the run command, those of the points excepted
    seeds: int
    folder: Path  # of the sweep
    options: RunOptions  # of each run, as the words give them


def read_spaces(base: Base, texts: Iterable[str], given: Sequence[str]) -> list[Space]:
    """Reads `SETTING=VALUES` texts.

    Args:
      base: the experiment whose settings they are.
      texts: of the command line.
      given: options that all points share.

    Raises:
      UserError: there is no such setting, it comes twice, or a value is of the wrong type.
    """
    found: dict[str, Space] = {}
    for text in texts:
        name, equals, values = text.partition("=")
        name = name.strip().removeprefix("--").replace("_", "-")
        if not equals:
            raise UserError(f"{text!r} names no values; give it as SETTING=1,2,3.")
        default = setting(base, name)
        if name in found or f"--{name}" in given:
            raise UserError(f"The setting {name} is given twice; leave one out.")
        whole = isinstance(default, int) and not isinstance(default, bool)
        found[name] = space = parse_space(name, values.strip(), whole)
        typed = [read_value(base, name, end) for end in space.ends]
        if twice := [end for i, end in enumerate(space.ends) if typed[i] in typed[:i]]:
            raise UserError(f"{name} has the value {twice[0]} twice; leave one out.")
    if not found:
        raise UserError("Nothing is swept; give --grid SETTING=1,2,3, or --over with --random.")
    return list(found.values())


def setting(base: Base, name: str) -> Any:
    """Returns the value of a setting; UserError with the nearest name if there is none."""
    if name == "seed":
        raise UserError("Each point is trained with several seeds already: give --seeds 3.")
    names = _names(base.chosen)
    if name not in names:
        said = f"There is no setting {name!r}. {other_trainers.suggest(name, names)}".strip()
        page = f"python -m purerl.run {shlex.quote(base.experiment)} --help"
        raise UserError(f"{said} All settings: {page}")
    return names[name]


def _names(value: Any, path: str = "") -> dict[str, Any]:
    """Returns the settings of an experiment, `ppo.learning-rate` -> value."""
    found: dict[str, Any] = {}
    own = value if isinstance(value, dict) else settings_json.settings_of(value)
    for name, inner in own.items():
        name = path + name.replace("_", "-")
        deeper = settings_json.has_settings(inner) or (isinstance(inner, dict) and inner)
        found |= _names(inner, f"{name}.") if deeper else {name: inner}
    return found


def read_value(base: Base, name: str, text: str) -> Any:
    """Returns a setting's value of the type that it has; UserError if it is of another."""
    value: Any = base.chosen
    kind: Any = Any
    for word in name.replace("-", "_").split("."):
        if isinstance(value, dict):
            kind, value = (get_args(kind) or (Any,))[-1], value[word]
        else:
            kind, value = kinds.hints(type(value)).get(word, Any), getattr(value, word)
    kind = type(value) if kind is Any else kind
    # A class with this setting alone: rules that join several settings come later, in `check`.
    one: Any = Annotated[kind, tyro.conf.arg(name=name)]
    alone = dataclasses.make_dataclass("Alone", [("value", one)], frozen=True)
    words = [_bool_word(name, text)] if isinstance(value, bool) else text.split()
    prog = f"python -m purerl.run {shlex.quote(base.experiment)}"
    return parse(alone, [f"--{name}", *words], prog, None, WORDS).value


def _bool_word(name: str, text: str) -> str:
    if text.lower() not in ("true", "false"):
        raise UserError(f"{name} is {text}; it must be true or false.")
    return text.capitalize()


def typed_values(base: Base, points: Sequence[Point]) -> list[dict[str, Any]]:
    """Returns each point's settings with their values: each text is read once, for it takes long.

    Raises:
      UserError: a value is of the wrong type.
    """
    pairs = {pair for point in points for pair in point.values.items()}
    read = {pair: read_value(base, *pair) for pair in sorted(pairs)}
    return [{name: read[name, text] for name, text in one.values.items()} for one in points]


def check_all(base: Base, points: Sequence[Point]) -> None:
    """Raises UserError if the settings of a point break a rule together."""
    for point, typed in zip(points, typed_values(base, points), strict=True):
        places = {Place(n.replace("-", "_").split(".")): x for n, x in typed.items()}
        try:
            replaced(base.chosen, places)
        except Exception as error:  # a rule of a dataclass, of ours or the user's
            shown = " ".join(f"{name}={text}" for name, text in point.values.items())
            raise UserError(f"The point {shown}: {one_line(error)}") from error


def check_evaluated(base: Base, spaces: Sequence[Space], metric: str) -> None:
    """Raises UserError where the score is one of evaluations, and a point may have none."""
    name = "evaluation.number"
    swept = [end for space in spaces if space.setting == name for end in space.ends]
    numbers = [read_value(base, name, end) for end in swept] or [base.chosen.evaluation.number]
    if metric.startswith("eval/") and 0 in numbers:
        raise UserError(
            f"{name} is 0, and a point without an evaluation has no {metric}; give at least 1, or "
            "another --metric, such as train/episode_return."
        )


def option_words(base: Base, name: str, text: str) -> list[str]:
    """Returns a setting with its value, as words of the run command: a flag has no value."""
    default = _names(base.chosen).get(name, getattr(RunOptions, name.replace("-", "_"), None))
    if isinstance(default, bool):
        return overrides.option_words(name, default, _bool_word(name, text) == "True")
    return [f"--{name}", *text.split()]


def job(base: Base, point: Point) -> Job:
    """Returns a point as what is to be run: all its seeds in one process."""
    words = [base.experiment, *base.words]
    for name, text in point.values.items():
        words += option_words(base, name, text)
    words += ["--runs", str(base.folder), "--name", point.name]
    names = [point.name]
    if base.seeds > 1:
        words += ["--num-seeds", str(base.seeds)]
        names = [f"{point.name}-seed{base.chosen.seed + i}" for i in range(base.seeds)]
    folders = tuple(base.folder / base.source.name / name for name in names)
    return Job(point.name, tuple(words), folders, base.folder / "logs" / f"{point.name}.log")
