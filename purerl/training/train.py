"""Training from Python and from the command line: both come to `train_runs`.

Nothing here imports JAX before a run begins, so that XLA's flags are set in time.
"""

import contextlib
import dataclasses
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Unpack, overload

from purerl.core.errors import UserError
from purerl.devices import threads
from purerl.exact import xla_flags
from purerl.experiment import command_line, settings_json, trust
from purerl.experiment.definition import Experiment
from purerl.experiment.loading import Source, find_source
from purerl.experiment.options import RunOptions, TrainOptions, check_seed
from purerl.experiment.source_hashes import hash_code
from purerl.machine import files, output, signals
from purerl.runs import checkpoint_folder, folder, manifest
from purerl.runs.loaded_run import Run


@overload
def train(
    experiment: str | Path,
    settings: Mapping[str, Any] | None = None,
    **options: Unpack[TrainOptions],
) -> Run: ...


@overload
def train(
    experiment: str | Path,
    settings: Mapping[str, Any] | None = None,
    *,
    num_seeds: int,
    **options: Unpack[TrainOptions],
) -> list[Run]: ...


def train(
    experiment: str | Path, settings: Mapping[str, Any] | None = None, **options: Any
) -> Run | list[Run]:
    """Trains an experiment: the folder, bits and lines of `python -m purerl.run`.

    A first SIGTERM or Ctrl-C saves and stops; a second one raises KeyboardInterrupt. A thread that
    is not the main one receives no signals.

    Args:
      experiment: a name in experiments/, the path of a Python file, or a dotted module.
      settings: dotted names of settings and their values, checked as on the command line.
      options: the run command's options: name, resume, num_seeds, runs, checkpoints, ... And
        `on_metrics`, which is called with each line of metrics.jsonl, a dict, when it is written;
        of vmapped seeds with the first one's line, whose train/episode_return is all seeds' mean.

    Returns:
      The run; where `num_seeds` is given, a list of them, also of one.

    Raises:
      UserError: a name, a value or a file is wrong; the message says how to mend it.
      RunError: the run cannot go on.
      StoppedError: the run was asked to stop, and is saved; go on with `resume=True`.

    >>> few = {"ppo.num_steps": 8192, "evaluation.number": 0}
    >>> run = train("cartpole_swingup", few, name="first", runs=place)  # doctest: +ELLIPSIS
    run          ...
    >>> run.update, run.steps
    (2, 8192)
    """
    if isinstance(experiment, Experiment):
        raise UserError(
            "A run keeps a copy of its experiment's file, and an Experiment object has none: put "
            "it into a .py file and give train that file's path. Change its settings by settings=."
        )
    began = time.perf_counter()
    set_xla_flags_in_time()
    listener = options.pop("on_metrics", None)
    if not (listener is None or callable(listener)):
        raise UserError(f"on_metrics is {listener!r}; it must be a function of a line of metrics.")
    source = find_source(str(experiment))
    chosen, how = command_line.from_settings(source, settings or {}, options, choose=as_begun)
    if how.video:
        raise UserError("video is an option of the command; call `python -m purerl.render RUN`.")
    folders = train_runs(source, chosen, how, _raise, began, listener)
    runs = [Run(path, trust=True) for path in folders]
    return runs if "num_seeds" in options else runs[0]


def train_runs(
    source: Source,
    chosen: Experiment,
    options: RunOptions,
    end: Callable,
    began: float,
    listener: Any = None,
) -> list[Path]:
    """Trains an experiment of every seed; returns their folders.

    Args:
      source: where the experiment came from.
      chosen: the experiment with its overrides.
      options: the run's options.
      end: called with an exit code at the second signal.
      began: when the command began, by `time.perf_counter` [s]: where `wall_s` is 0.
      listener: called with each line of metrics, or None.
    """
    from purerl.training.session import Call, execute

    files.check_name("The experiment's name", source.name)
    if options.name is not None:
        files.check_name("name", options.name)
    runs = _folders(source, chosen, options)
    trust.remember(source.text, source.path)
    found = [folder.read(path) for path in runs]
    begun_portable = options.resume and any(manifest.was_portable(one.manifest) for one in found)
    if options.portable or begun_portable:
        set_portable_flags_in_time()
    threads.leave_one(chosen.engine)
    with signals.stop_signals(end) as stop:
        execute(source, runs, found, options, Call(began, stop, listener))
    return list(runs)


def as_begun(source: Source, over: command_line.Over) -> tuple[Experiment, RunOptions]:
    """Returns what a command line makes of the settings that a run which goes on was begun with.

    So what the command leaves out stays as it is. Where the experiment's file has been edited since
    then, or there is no such run, the file's own settings count.

    Args:
      source: the experiment.
      over: returns an experiment, and options by name, with what the command line has instead.
    """
    known = chosen, options = over(source.experiment)
    if not options.resume or options.debug:
        return known
    place = next(iter(_folders(source, chosen, options)))
    with contextlib.suppress(UserError, OSError):  # told where the folder is read as a run's
        # Without a checkpoint nothing was trained: a mistake in the command may have ended it.
        trained = checkpoint_folder.updates(place / folder.CHECKPOINTS)
        if trained and hash_code(files.read_bytes(place / folder.CODE)) == hash_code(source.text):
            begun = files.read_json(place / folder.CONFIG, settings=dict, schedule=dict)
            schedule = files.check_object("", begun["schedule"], log_every=int, checkpoints=int)
            both = {name: schedule[name] for name in ("log_every", "checkpoints")}
            known = over(settings_json.from_json(source.experiment, begun["settings"]), **both)
    if unlike := manifest.differences(*map(settings_json.to_json, (chosen, known[0]))):
        output.say(f"settings     as the run was begun: {', '.join(unlike)}")
    return known


def _folders(source: Source, chosen: Experiment, options: RunOptions) -> dict[Path, Experiment]:
    """Returns each seed's folder, and the experiment with that seed."""
    runs, place = {}, options.runs
    if options.debug and place == RunOptions.runs:
        place = Path(tempfile.mkdtemp(prefix="purerl-debug-"))
    for seed in range(chosen.seed, chosen.seed + options.num_seeds):
        check_seed(seed)
        name = options.name or f"seed{seed}"
        if options.num_seeds > 1 and options.name:
            name += f"-seed{seed}"
        runs[place / source.name / name] = dataclasses.replace(chosen, seed=seed)
    return runs


def set_xla_flags_in_time() -> None:
    """Sets XLA's flags; where JAX runs on a GPU without them, says so and leaves them out.

    Then the manifest says that the run is not bit-exact. On a CPU they change nothing.
    """
    try:
        xla_flags.set_xla_flags()
    except RuntimeError as error:
        output.say(f"This run is not bit-exact: {error}")
        return
    kept = os.environ.get(xla_flags.KEPT_TIMINGS)
    if "jax" in sys.modules and kept is not None:  # it read the environment when it was imported
        sys.modules["jax"].config.update(xla_flags.KEPT_TIMINGS.lower(), kept)


def set_portable_flags_in_time() -> None:
    """Sets what makes bits portable; UserError where this processor or process cannot have them."""
    if not {"avx2", "fma"} <= set(manifest.processor("flags").split()):
        raise UserError(
            "Portable bits are those of x86-64 processors with AVX2 and FMA, and this one "
            f"({manifest.processor('model name') or platform.machine()}) has not both; leave out "
            "--portable."
        )
    try:
        xla_flags.set_portable_flags()
    except (RuntimeError, ValueError) as error:
        raise UserError(str(error)) from error


def _raise(code: int) -> None:
    raise KeyboardInterrupt
