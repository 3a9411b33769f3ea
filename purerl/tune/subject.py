"""What is planned for or looked at: an experiment, or a run with what it has learned."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import UserError, some
from purerl.experiment import definition, loading
from purerl.experiment.command_line import from_command_line, parse
from purerl.experiment.options import EpisodeOptions, PlayOptions
from purerl.machine import output
from purerl.report import run_reader, seed_statistics
from purerl.runs import folder, loaded_run
from purerl.tune.plan.settings import Settings

SETTABLE = ("env", "engine")  # of an experiment's settings


@dataclass(frozen=True)
class PlanOptions(EpisodeOptions, Settings):
    """How plans are made, and which episodes they are for."""

    def __post_init__(self) -> None:
        """Checks the rules."""
        Settings.__post_init__(self)
        EpisodeOptions.__post_init__(self)


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
    output.show(*str(about).split("\n"), f"Of the environment: {prog} NAME --help", "")
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
    # How to read the run, whose experiment says which other options there are.
    here = [word for word in words if word not in ("-h", "--help")]
    known, _ = parse(PlayOptions, here, prog, return_unknown_args=True)
    run = loaded_run.load(name, known.checkpoint, known.engine, known.trust)
    return Subject(name, loading.Source(run.experiment, name, run.folder / folder.CODE), run)


def find_runs(words: Sequence[str], prog: str) -> tuple[Subject, dict[str, Any], list[str]]:
    """Finds the runs that the words before the first option mean.

    Returns:
      The first one as a subject, name -> what `load` returned of each, and the other words.

    Raises:
      UserError: there are none, or they are not of one configuration.
    """
    number = next((i for i, word in enumerate(words) if word.startswith("-")), len(words))
    places = [loading.shipped(word) or Path(word) for word in words[:number]]
    records = run_reader.read_runs(places, prog.split(".")[-1])
    if names := some(seed_statistics.differing(records), 3):
        raise UserError(f"The runs differ in {names}; give runs that differ in their seed alone.")
    found = [find([str(x.path), *words[number:]], prog) for x in records]
    shipped = [loading.is_shipped(path := Path(x.name)) and path.name for x in found]
    found = [x._replace(name=name or x.name) for x, name in zip(found, shipped, strict=True)]
    return found[0], {x.name: x.run for x in found}, list(words[number:])


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
    prog = f"{prog} {shlex.quote(subject.name)}"
    experiment, options = from_command_line(subject.source, words, prog, base=base, names=names)
    if subject.run is None and getattr(options, "checkpoint", "latest") != "latest":
        raise UserError(f"{subject.name} is an experiment: --checkpoint is for a run's folder.")
    return experiment, options


def one_run(words: Sequence[str], prog: str, base: Any) -> tuple[Any, Any, Any]:
    """Returns the one run that a command line means, and experiment and options as `chosen`."""
    found, runs, words = find_runs(words, prog)
    if len(runs) > 1:
        raise UserError(f"{len(runs)} runs are given; {prog.split('.')[-1]} one at a time.")
    return found, *chosen(found, words, prog, base)
