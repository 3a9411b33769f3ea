"""What is planned for: an experiment, or a run with what it has learned."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import UserError
from purerl.runs import experiment
from purerl.runs.build_experiment import Setup, build
from purerl.runs.command_line import from_command_line
from purerl.runs.experiment import Source
from purerl.runs.options import check_seed
from purerl.tune.plan.settings import Settings

AGAINST = "--against"
SETTABLE = ("env", "engine")  # of an experiment's settings


@dataclass(frozen=True)
class Options(Settings):
    """What is planned, and what becomes of it."""

    episodes: int = 1
    """Episodes, planned side by side; intervals need 5, those of --against too."""
    steps: int = 0
    """Control steps of an episode at most; 0: the experiment's time limit."""
    seed: int = 0
    """Seed of the episodes and the plans: episodes begin as those of `evaluate`."""
    policy: bool = True
    """Of a run: plans correct its policy's actions, and its value counts at the horizon."""
    checkpoint: str = "latest"
    """Of a run: latest, best (highest evaluation return), or an update's number."""
    trust: bool = False
    """Execute the run's experiment.py though this machine does not know it: read it first."""
    csv: Path | None = None
    """Write a row for each episode to this file."""
    json: Path | None = None
    """Write settings and figures to this file."""
    video: Path | None = None
    """Write a video (mp4) of the episodes to this file, and a contact sheet (PNG) beside it."""

    def __post_init__(self) -> None:
        """Checks the rules."""
        super().__post_init__()
        check_seed(self.seed)
        for name, least in (("episodes", 1), ("steps", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {least}.")
        for name in ("csv", "json", "video"):
            file = getattr(self, name)
            if file is not None and (file.is_dir() or not file.absolute().parent.is_dir()):
                raise ValueError(f"{name} is {file}; it must be a file in a folder that exists.")
        if self.video is not None and self.video.suffix != ".mp4":
            raise ValueError(f"video is {self.video}; its name must end in .mp4.")


@dataclass(frozen=True)
class Nothing:
    """The options after `--against`: none but the environment's."""


class Problem(NamedTuple):
    """What is planned for."""

    name: str
    setup: Setup
    learned: Any  # a run's TrainState; None: nothing


def is_run(name: str) -> bool:
    """Tells whether the command's first word names a run's folder, and not an experiment."""
    return Path(name).is_dir()


def read(words: Sequence[str], prog: str) -> tuple[Problem, Problem | None, Options]:
    """Reads a command line: what is planned for, and under which other settings too.

    Args:
      words: an experiment or a run, options, and after `--against` other settings of the
        environment.
      prog: the command, for errors.

    Raises:
      UserError: there is no such experiment, run or option, or a value is wrong.
    """
    if not words or words[0].startswith("-"):
        raise UserError(f"The first word must be an experiment or a run: {prog} EXPERIMENT_OR_RUN")
    words, after = list(words), None
    if AGAINST in words:
        place = words.index(AGAINST)
        words, after = words[:place], words[place + 1 :]
    name, prog = words[0], f"{prog} {words[0]}"
    source, learned = (_of_run if is_run(name) else _of_experiment)(words)
    chosen, options = from_command_line(source, words[1:], prog, base=Options, names=SETTABLE)
    problem = Problem(name, build(chosen), learned if options.policy else None)
    if after is None:
        return problem, None, options
    source = source._replace(experiment=chosen)
    other, _ = from_command_line(source, after, f"{prog} {AGAINST}", base=Nothing, names=("env",))
    if other.env == chosen.env:
        raise UserError(
            f"The settings after {AGAINST} are those before it: give what differs, such as "
            f"{prog} {AGAINST} --env.forward-weight 2."
        )
    return problem, problem._replace(setup=build(other)), options


def _of_experiment(words: Sequence[str]) -> tuple[Source, None]:
    return experiment.find_source(words[0]), None


def _of_run(words: Sequence[str]) -> tuple[Source, Any]:
    """Reads a run: the settings that can be given after it are its experiment's."""
    from purerl.runs.loaded_run import load

    early: Callable[..., Any] = argparse.ArgumentParser
    parser = early(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--checkpoint", default="latest")
    parser.add_argument("--trust", action="store_true")
    try:
        known, _ = parser.parse_known_args(words[1:])
    except argparse.ArgumentError as error:
        raise UserError(f"The command line is wrong: {error}.") from error
    run = load(words[0], known.checkpoint, trust=known.trust)
    file = Path(words[0]) / "experiment.py"
    return Source(run.experiment, words[0], file), run.state
