"""What a window begins with, and where it gets the rest; a run is only read."""

import functools
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

from purerl.core.errors import UserError, one_line
from purerl.core.records import TrainState
from purerl.devices.compilation import set_up_jax
from purerl.experiment import loading
from purerl.experiment.definition import Experiment
from purerl.experiment.objects import Setup, build
from purerl.machine.output import show
from purerl.runs import checkpoint_folder, loaded_run, restored_run
from purerl.runs.folder import CHECKPOINTS, CODE, read_run
from purerl.tune import option_numbers, overrides
from purerl.tune.plan import planner
from purerl.tune.subject import Subject
from purerl.tune.view.drivers import Driver, planner_driver, policy_driver
from purerl.tune.view.program import Numbers, build_program
from purerl.tune.view.session import Session, open_session


class Source(NamedTuple):
    """Where sessions get what takes time, and words.

    `program(numbers) -> Program` and `brain(name) -> (brain, words)` raise UserError;
    `checkpoints() -> names`; `words(numbers) -> overrides`; `command(numbers) -> command line`.
    """

    program: Callable[[Numbers], Any]
    words: Callable[[Numbers], str]
    command: Callable[[Numbers], str]
    checkpoints: Callable[[], Sequence[str]] = tuple
    brain: Any = None  # where there are checkpoints


def open_window(subject: Subject, chosen: Experiment, options: Any) -> tuple[Session, Source, str]:
    """Opens an experiment, or a run.

    Args:
      subject: what the command names.
      chosen: its experiment, with the settings that the command gives.
      options: of the command.

    Returns:
      The session at its start, the source of the rest, and the page's title.

    Raises:
      UserError: its environment cannot be drawn, or there is no policy to drive.
    """
    if subject.run is None:
        return _of_experiment(subject, chosen, options)
    return _of_run(subject.run, chosen, options)


def _of_run(run: loaded_run.Run, chosen: Experiment, options: Any) -> tuple[Session, Source, str]:
    setup, brain = run.restored.setup, jax.device_put(run.state)
    guide = functools.partial(planner.guide, setup.config, setup.network)
    planned = options.drive == "planner"
    driver = planner_driver(options, guide, brain) if planned else policy_driver(guide, brain)

    def other_brain(name: str) -> tuple[TrainState, str]:
        saved = restored_run.read_checkpoint(read_run(run.folder), name, setup, show)
        return jax.device_put(saved.state), _words(saved.meta["update"], saved.meta["steps"])

    written = run.restored.source.experiment
    source = _source(setup, driver, brain, written, chosen, command_name(run))
    names = functools.partial(checkpoint_names, run.folder, options.checkpoint)
    source = source._replace(brain=other_brain, checkpoints=names)
    words = _words(run.update, run.steps)
    title = f"{run.folder.absolute().parent.name}/{run.folder.absolute().name}"
    return _open(source, setup, brain, words, options), source, title


def _of_experiment(
    subject: Subject, chosen: Experiment, options: Any
) -> tuple[Session, Source, str]:
    if options.drive == "policy":
        raise UserError(f"{subject.name} is no run's folder: an experiment has no policy to drive.")
    set_up_jax(cache=True)
    setup, written = build(chosen), subject.source.experiment
    driver = planner_driver(options, lambda _: planner.unguided(setup.env.action_size), ())
    source = _source(setup, driver, (), written, chosen, subject.name)
    words = f"{options.planner}, {options.samples} plans of {options.horizon} steps"
    return _open(source, setup, (), words, options), source, subject.source.name


def _source(
    setup: Setup, driver: Driver, brain: Any, written: Experiment, chosen: Experiment, name: str
) -> Source:
    """Returns the source of programs and words, without checkpoints.

    Args:
      setup: the experiment's objects.
      driver: who drives.
      brain: for its shapes.
      written: the experiment as its file has it.
      chosen: with the run's settings.
      name: that `python -m purerl.run` knows it by.
    """
    observed = jax.eval_shape(setup.env.reset, jax.random.key(0)).observation

    def program(numbers: Numbers) -> Any:
        changed = option_numbers.replaced(chosen.env, numbers)
        known = observed if jax.tree.leaves(brain) else None
        return build_program(chosen.build_env, changed, setup.engine, driver, brain, known)

    def told(numbers: Numbers, words: Callable[[Any], str]) -> str:
        try:
            return words(option_numbers.replaced(chosen.env, numbers))
        except Exception as error:  # a rule of the options, until the sliders are taken back
            return one_line(error)

    words = lambda env: shlex.join(overrides.option_words("env", written.env, env))  # noqa: E731
    command = functools.partial(overrides.train_command, name, written, chosen)
    both = (functools.partial(told, words=one) for one in (words, command))
    return Source(program, *both)


def _open(source: Source, setup: Setup, brain: Any, words: str, options: Any) -> Session:
    limit = setup.config.episode_length
    return open_session(source.program({}), brain, words, limit, options.seed)


def _words(update: int, steps: int) -> str:
    return f"policy of update {update:,} ({steps:,} steps)"


def checkpoint_names(folder: Path, first: str) -> list[str]:
    """Returns the checkpoints that can be chosen now, the newest first after `first`."""
    try:
        updates = checkpoint_folder.updates(folder / CHECKPOINTS)
    except OSError:  # it may be moved, or a disk away for a moment
        updates = []
    return list(dict.fromkeys([first, "latest", "best", *map(str, reversed(updates))]))


def command_name(run: loaded_run.Run) -> str:
    """Returns what `python -m purerl.run` knows the run's experiment by."""
    name = run.restored.source.name
    if name in loading.available():
        return name
    place = Path(run.restored.folder.manifest.get("experiment_file", ""))
    return str(place if place.is_file() else run.folder / CODE)
