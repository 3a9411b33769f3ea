"""What is planned for: a subject under some settings, or the same under two."""

import dataclasses
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import UserError, check_least
from purerl.experiment import definition, objects, settings_json
from purerl.machine.files import check_writable
from purerl.tune import overrides, subject
from purerl.tune.subject import PlanOptions, Subject

AGAINST = "--against"
BOTH = ("first", "second")  # the settings before it, and after it


@dataclass(frozen=True)
class PlanCommandOptions(PlanOptions):
    """What is planned, and what becomes of it."""

    episodes: int = 1
    """Episodes, planned side by side; intervals need 5, those of --against too."""
    steps: int = 0
    """Control steps of an episode at most; 0: the experiment's time limit."""
    no_policy: bool = False
    """Of a run: plan as if nothing were learned. By default, plans correct its policy's actions,
    and what its value says of a plan's last state counts."""
    csv: Path | None = None
    """Write a row for each episode to this file."""
    json: Path | None = None
    """Write settings and figures to this file."""
    video: Path | None = None
    """Write a video (mp4) of the episodes to this file, and a contact sheet (PNG) beside it."""

    def __post_init__(self) -> None:
        """Checks the rules."""
        super().__post_init__()
        check_least(self, ValueError, episodes=1, steps=0)
        for file in filter(None, (self.csv, self.json, self.video)):
            check_writable(file)
        if self.csv is not None and self.csv == self.json:
            raise ValueError(f"csv and json are both {self.csv}; they must be two files.")
        if self.video is not None and self.video.suffix != ".mp4":
            raise ValueError(f"video is {self.video}; its name must end in .mp4.")


@dataclass(frozen=True)
class Nothing:
    """The options after `--against`: none but the environment's."""


class Problem(NamedTuple):
    """What is planned for."""

    name: str
    title: str  # of its column
    words: str  # the settings of the environment that are not those of the experiment's file
    settings: dict[str, Any]  # all of them, as config.json has a run's
    setup: objects.Setup
    learned: Any  # a run's TrainState; None: nothing
    trained: str  # what of a run that is, in words


def read(words: Sequence[str], prog: str) -> tuple[Problem, Problem | None, PlanCommandOptions]:
    """Reads a command line: what is planned for, and under which other settings too.

    Args:
      words: an experiment or a run, options, and after `--against` other settings of the
        environment, beside those before it.
      prog: the command, for errors.

    Raises:
      UserError: there is no such experiment, run or option, or a value is wrong.
    """
    words, after = list(words), None
    if AGAINST in words:
        place = words.index(AGAINST)
        words, after = words[:place], words[place + 1 :]
    found = subject.find(words, prog)
    chosen, options = subject.chosen(found, words[1:], prog, PlanCommandOptions)
    if found.run is None and options.no_policy:
        raise UserError(f"{found.name} is an experiment: --no-policy is for a run's folder.")
    first = _problem(found, chosen, options)
    if after is None:
        return first, None, options
    _check_after(after, f"{prog} {shlex.quote(found.name)}")
    begin = found._replace(source=found.source._replace(experiment=chosen))
    other, _ = subject.chosen(begin, after, prog, Nothing, ("env",))
    if other.env == chosen.env:
        raise UserError(
            f"The settings after {AGAINST} are those before it: give what differs "
            f"({_example(chosen.env)})."
        )
    both = (first, _problem(found, other, options))
    first, second = (one._replace(title=title) for one, title in zip(both, BOTH, strict=True))
    return first, second, options


def _problem(found: Subject, chosen: definition.Experiment, options: PlanCommandOptions) -> Problem:
    run = None if options.no_policy else found.run
    written = found.source if found.run is None else found.run.restored.source
    return Problem(
        name=found.name,
        title=options.planner if run is None else f"{options.planner} + policy",
        words=" ".join(overrides.option_words("env", written.experiment.env, chosen.env)),
        settings=settings_json.to_json(chosen)["env"],
        setup=objects.build(chosen),
        learned=None if run is None else run.state,
        trained="" if run is None else f"update {run.update:,} ({run.steps:,} steps)",
    )


def _check_after(after: Sequence[str], prog: str) -> None:
    """Raises UserError for what cannot stand after `--against`."""
    mine = {f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(PlanCommandOptions)}
    wrong = next((word for word in after if word.split("=")[0] in mine | {"--engine"}), None)
    if wrong:
        raise UserError(
            f"{wrong} stands after {AGAINST}, where only settings of the environment (--env...) "
            f"stand; everything else comes before it: {prog} {wrong} ... {AGAINST} ..."
        )


def _example(env: Any) -> str:
    """Returns a setting of an environment as an example."""
    names = [f.name for f in dataclasses.fields(env)] if dataclasses.is_dataclass(env) else []
    return f"--env.{names[0].replace('_', '-')} ..." if names else "--env.NAME ..."
