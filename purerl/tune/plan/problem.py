"""What is planned for: a subject under some settings, or the same under two."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import UserError
from purerl.runs.build_experiment import Setup, build
from purerl.runs.options import check_seed
from purerl.tune import subject
from purerl.tune.plan.settings import Settings

AGAINST = "--against"


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


def read(words: Sequence[str], prog: str) -> tuple[Problem, Problem | None, Options]:
    """Reads a command line: what is planned for, and under which other settings too.

    Args:
      words: an experiment or a run, options, and after `--against` other settings of the
        environment.
      prog: the command, for errors.

    Raises:
      UserError: there is no such experiment, run or option, or a value is wrong.
    """
    words, after = list(words), None
    if AGAINST in words:
        place = words.index(AGAINST)
        words, after = words[:place], words[place + 1 :]
    found = subject.find(words, prog)
    prog = f"{prog} {found.name}"
    chosen, options = subject.chosen(found, words[1:], prog, Options)
    learned = found.run.state if found.run is not None and options.policy else None
    problem = Problem(found.name, build(chosen), learned)
    if after is None:
        return problem, None, options
    found = found._replace(source=found.source._replace(experiment=chosen))
    other, _ = subject.chosen(found, after, f"{prog} {AGAINST}", Nothing, ("env",))
    if other.env == chosen.env:
        raise UserError(
            f"The settings after {AGAINST} are those before it: give what differs, such as "
            f"{prog} {AGAINST} --env.forward-weight 2."
        )
    return problem, problem._replace(setup=build(other)), options
