"""What is planned for or looked at: an experiment, or a run with what it has learned."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import UserError
from purerl.experiment import definition, loading
from purerl.experiment.command_line import from_command_line, parse
from purerl.experiment.options import check_seed
from purerl.machine import output
from purerl.runs import folder, loaded_run
from purerl.tune.plan.settings import Settings

SETTABLE = ("env", "engine")  # of an experiment's settings


@dataclass(frozen=True)
class PlanOptions(Settings):
    """How plans are made, and which episodes they are for."""

    seed: int = 0
    """Seed of the episodes and of the plans; episodes begin as those of `evaluate`, and never meet
    a seed of training."""
    checkpoint: str = "latest"
    """Of a run: latest, best (highest evaluation return), or an update's number."""
    trust: bool = False
    """Execute the run's experiment.py though this machine does not know it: read it first."""

    def __post_init__(self) -> None:
        """Checks the rules."""
        super().__post_init__()
        check_seed(self.seed)


class Subject(NamedTuple):
    """What a command's first word names."""

    name: str  # the word
    source: loading.Source  # the experiment, a run's with the run's settings
    run: loaded_run.Run | None  # if it is one


def show_help(base: Any, about: str | None, prog: str, words: Sequence[str]) -> None:
    """Prints the help page of a command whose first word is a subject.

    Args:
      base: the dataclass of its options, which are listed if the `words` ask for it.
      about: of the command. The options of an environment are on the page that it has for that.
      prog: the command's own words.
      words: the command line.
    """
    output.show(*str(about).split("\n"), f"Of the environment: {prog} EXPERIMENT --help", "")
    if words:
        parse(base, ["--help"], prog)


def find(words: Sequence[str], prog: str, policies: bool = False) -> Subject:
    """Finds what the first of the words names.

    Args:
      words: the command line.
      prog: the command before it, for errors.
      policies: whether a name may mean a policy that comes with purerl, rather than the experiment.

    Raises:
      UserError: there is no such experiment or run.
    """
    if not words or words[0].startswith("-"):
        raise UserError(f"The first word must be an experiment or a run: {prog} EXPERIMENT_OR_RUN")
    name = words[0]
    if not (Path(name).is_dir() or policies and loading.shipped(name)):
        return Subject(name, loading.find_source(name), None)
    # Options that say how to read the run, whose experiment says which other options there are.
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--checkpoint", default="latest")
    parser.add_argument("--engine", default="")
    parser.add_argument("--trust", action="store_true")
    try:
        known, _ = parser.parse_known_args(words[1:])
    except argparse.ArgumentError as error:
        raise UserError(f"The command line is wrong: {error}.") from error
    run = loaded_run.load(name, known.checkpoint, known.engine, known.trust)
    return Subject(name, loading.Source(run.experiment, name, run.folder / folder.CODE), run)


def chosen(
    subject: Subject, words: Sequence[str], prog: str, base: Any, names: Sequence[str] = SETTABLE
) -> tuple[definition.Experiment, Any]:
    """Returns the subject's experiment with the settings that the words give, and the options.

    Args:
      subject: the subject.
      words: the command line after its name.
      prog: the command before them, for errors.
      base: the dataclass of the command's options.
      names: of the settings that can be given.

    Raises:
      UserError: there is no such option, or a value is wrong.
    """
    experiment, options = from_command_line(subject.source, words, prog, base=base, names=names)
    if subject.run is None and getattr(options, "checkpoint", "latest") != "latest":
        raise UserError(f"{subject.name} is an experiment: --checkpoint is for a run's folder.")
    return experiment, options
