"""What a window on a run begins with, and where it gets the rest; the run is only read."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

from purerl.core.records import TrainState
from purerl.runs import checkpoint_folder, experiment, files
from purerl.runs.loaded_run import Run, load
from purerl.runs.output import show
from purerl.runs.restored_run import read_checkpoint
from purerl.view import overrides
from purerl.view.option_numbers import replaced
from purerl.view.program import Brain, Numbers, build_program, policy_driver
from purerl.view.session import Session, open_session


class Source(NamedTuple):
    """Where sessions get what takes time, and words; all are called with a session's own values.

    `program(numbers) -> Program` and `brain(name) -> (brain, words)` raise UserError;
    `checkpoints() -> names`; `words(numbers) -> overrides`; `command(numbers) -> command line`.
    """

    program: Callable[[Any], Any]
    brain: Callable[[str], tuple[Any, str]]
    checkpoints: Callable[[], Sequence[str]]
    words: Callable[[Any], str]
    command: Callable[[Any], str]


def of_run(options: Any) -> tuple[Session, Source, str]:
    """Reads a run as `PlayOptions` name it.

    Returns:
      The session at its start, the source of the rest, and the page's title.

    Raises:
      UserError: it is no run, or its environment cannot be drawn.
    """
    run = load(options.run, options.checkpoint, options.engine, options.trust)
    setup, chosen = run.restored.setup, run.experiment
    observed = jax.eval_shape(run.env.reset, jax.random.key(0)).observation
    driver, brain = policy_driver(run.network, run.state.carry), _brain(run.state)

    def program(numbers: Numbers) -> Any:
        changed = replaced(chosen.env, numbers)
        return build_program(chosen.build_env, changed, setup.engine, driver, brain, observed)

    def other_brain(name: str) -> tuple[Brain, str]:
        saved = read_checkpoint(run.folder, name, setup, show)
        return _brain(saved.state), _words(saved.meta["update"], saved.meta["steps"])

    written, name = run.restored.source.experiment, command_name(run)
    source = Source(
        program=program,
        brain=other_brain,
        checkpoints=lambda: checkpoint_names(run.folder, options.checkpoint),
        words=lambda numbers: " ".join(
            overrides.environment_words(written, replaced(chosen.env, numbers))
        ),
        command=lambda numbers: overrides.train_command(
            name, written, chosen, replaced(chosen.env, numbers)
        ),
    )
    words = _words(run.update, run.steps)
    session = open_session(program({}), brain, words, setup.config.episode_length, options.seed)
    return session, source, f"{run.folder.parent.name}/{run.folder.name}"


def _brain(state: TrainState) -> Brain:
    return Brain(state.params, state.normalizer)


def _words(update: int, steps: int) -> str:
    return f"of update {update:,} ({steps:,} steps)"


def checkpoint_names(folder: Path, first: str) -> list[str]:
    """Returns the checkpoints that can be chosen now, the newest first after `first`."""
    try:
        updates = checkpoint_folder.updates(folder / "checkpoints")
    except OSError:  # it may be moved, or a disk away for a moment
        updates = []
    return list(dict.fromkeys([first, "latest", "best", *map(str, reversed(updates))]))


def command_name(run: Run) -> str:
    """Returns what `python -m purerl.run` knows the run's experiment by."""
    name = files.read_json(run.folder / "config.json")["experiment"]
    if name in experiment.available():
        return name
    place = Path(files.read_json(run.folder / "manifest.json").get("experiment_file", ""))
    return str(place if place.is_file() else run.folder / "experiment.py")
