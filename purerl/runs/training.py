"""Training from Python and from the command line: both come to `train_runs`.

Nothing here imports JAX before a run begins, so that XLA's flags are set in time.
"""

import dataclasses
import os
import platform
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from purerl.core.errors import UserError
from purerl.devices import threads
from purerl.exact import xla_flags
from purerl.runs import output
from purerl.runs.command_line import from_settings
from purerl.runs.experiment import Experiment, Source, find_source
from purerl.runs.files import check_name
from purerl.runs.loaded_run import Run
from purerl.runs.options import Options, check_seed
from purerl.runs.trust import remember


def train(
    experiment: str | Path, settings: Mapping[str, Any] | None = None, **options: Any
) -> Run | list[Run]:
    """Trains an experiment: the folder, bits and lines of `python -m purerl.run`.

    A first SIGTERM or Ctrl-C saves and stops; a second one raises KeyboardInterrupt. A thread that
    is not the main one receives no signals.

    Args:
      experiment: a name in experiments/, the path of a Python file, or a dotted module.
      settings: dotted names of settings and their values, checked as on the command line.
      options: the run command's options: name, resume, num_seeds, runs, checkpoints, ...

    Returns:
      The run, or with `num_seeds` above 1 a list of them.

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
    set_xla_flags_in_time()
    source = find_source(str(experiment))
    chosen, how = from_settings(source, settings or {}, options)
    if how.video:
        raise UserError("video is an option of the command; call `python -m purerl.render RUN`.")
    runs = [Run(folder, trust=True) for folder in train_runs(source, chosen, how, _interrupt)]
    return runs[0] if how.num_seeds == 1 else runs


def train_runs(
    source: Source, chosen: Experiment, options: Options, end: Callable[[int], Any]
) -> list[Path]:
    """Trains an experiment of every seed; returns their folders.

    Args:
      source: where the experiment came from.
      chosen: the experiment with its overrides.
      options: the run's options.
      end: called with an exit code at the second signal.
    """
    from purerl.runs import manifest
    from purerl.runs.session import execute

    check_name("The experiment's name", source.name)
    if options.name is not None:
        check_name("name", options.name)
    place, runs = options.runs / source.name, {}
    for seed in range(chosen.seed, chosen.seed + options.num_seeds):
        check_seed(seed)
        name = options.name or f"seed{seed}"
        if options.num_seeds > 1 and options.name:
            name += f"-seed{seed}"
        runs[place / name] = dataclasses.replace(chosen, seed=seed)
    remember(source.text, source.path)
    if options.portable or (options.resume and any(map(manifest.was_portable, runs))):
        set_portable_flags_in_time()
    threads.leave_one(chosen.engine)
    with stop_signals(end) as stop:
        execute(source, runs, options, stop)
    return list(runs)


def set_xla_flags_in_time() -> None:
    """Sets XLA's flags; where JAX runs on a GPU without them, says so and leaves them out.

    Then the manifest says that the run is not bit-exact. On a CPU they change nothing.
    """
    if _runs_on_gpu() and xla_flags.how_chosen("gpu") == "by timing":
        output.say(
            "JAX has begun on the GPU with kernels chosen by timing, so this run is not bit-exact: "
            "call purerl.exact.set_xla_flags() before JAX's first computation."
        )
        return
    xla_flags.set_xla_flags()
    kept = os.environ.get(xla_flags.KEPT_TIMINGS)
    if "jax" in sys.modules and kept is not None:  # it read the environment when it was imported
        sys.modules["jax"].config.update(xla_flags.KEPT_TIMINGS.lower(), kept)


def set_portable_flags_in_time() -> None:
    """Sets what makes bits portable; UserError where this processor or process cannot have them."""
    from purerl.runs.manifest import processor

    if not {"avx2", "fma"} <= set(processor("flags").split()):
        raise UserError(
            "Portable bits are those of x86-64 processors with AVX2 and FMA, and this one "
            f"({processor('model name') or platform.machine()}) has not both; leave out --portable."
        )
    if threads.jax_has_begun() and not xla_flags.is_portable():
        raise UserError(
            "JAX has begun with other flags than portable bits need: begin a new process, or call "
            "purerl.exact.set_portable_flags() before JAX's first computation."
        )
    try:
        xla_flags.set_portable_flags()
    except ValueError as error:
        raise UserError(str(error)) from error


def _runs_on_gpu() -> bool:
    return threads.jax_has_begun() and sys.modules["jax"].default_backend() == "gpu"


@contextmanager
def stop_signals(
    end: Callable[[int], Any], then: str = "finishing this chunk, then saving"
) -> Iterator[Callable[[], bool]]:
    """Yields a question: did SIGTERM or SIGINT ask to stop? A second signal calls `end(exit code)`.

    `then` is what is told at the first.

    Only the main thread receives signals: in another one the answer is always no.
    """
    received: list[int] = []

    def handle(number: int, frame: Any) -> None:
        if received:
            end(128 + number)
            return
        received.append(number)
        name = signal.Signals(number).name
        output.warn(f"\n{name}: {then}. Once more to stop at once.")

    old = {}
    if threading.current_thread() is threading.main_thread():
        old = {number: signal.signal(number, handle) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)


def _interrupt(code: int) -> None:
    raise KeyboardInterrupt
