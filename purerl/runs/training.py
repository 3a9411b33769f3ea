"""Training from Python and from the command line: both come to `train_runs`.

Nothing here imports JAX before a run begins, so that XLA's flags are set in time.
"""

import dataclasses
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from purerl.exact import xla_flags
from purerl.runs.command_line import from_settings
from purerl.runs.experiment import Experiment, Source, find_source
from purerl.runs.experiment_file import source_of
from purerl.runs.loaded_run import Run
from purerl.runs.options import Options


def train(
    experiment: str | Path | Experiment,
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> Run | list[Run]:
    """Trains an experiment: the folder, bits and lines of `python -m purerl.run`.

    A first SIGTERM or Ctrl-C saves and stops; a second one raises KeyboardInterrupt. A thread that
    is not the main one receives no signals.

    Args:
      experiment: a name in experiments/, the path of a Python file, a dotted module, or an object.
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
    set_xla_flags_in_time()
    with ExitStack() as stack:
        if isinstance(experiment, Experiment):
            source = stack.enter_context(source_of(experiment))
        else:
            source = find_source(str(experiment))
        chosen, how = from_settings(source, settings or {}, options)
        runs = runs_of(source, chosen, how)
        stop = stack.enter_context(stop_signals(_interrupt))
        train_runs(source, runs, how, stop)
    found = [Run(folder) for folder in runs]
    return found[0] if how.num_seeds == 1 else found


def train_runs(
    source: Source, runs: dict[Path, Experiment], options: Options, stop: Callable[[], bool]
) -> None:
    """Trains runs, given each one's folder and experiment; `stop` is asked whether to stop."""
    from purerl.devices.processes import fail_together
    from purerl.runs.session import execute

    with ExitStack() as stack:
        stack.enter_context(fail_together())
        execute(source, runs, options, stop, stack)


def runs_of(source: Source, chosen: Experiment, options: Options) -> dict[Path, Experiment]:
    """Returns each seed's folder and experiment."""
    place, last = options.runs / source.name, chosen.seed + options.num_seeds
    if options.num_seeds == 1:
        return {place / (options.name or f"seed{chosen.seed}"): chosen}
    prefix = f"{options.name}-" if options.name else ""
    return {
        place / f"{prefix}seed{seed}": dataclasses.replace(chosen, seed=seed)
        for seed in range(chosen.seed, last)
    }


def set_xla_flags_in_time() -> None:
    """Sets XLA's flags; where JAX runs on a GPU without them, says so and leaves them out.

    Then the manifest says that the run is not bit-exact. On a CPU they change nothing.
    """
    if _runs_on_gpu() and xla_flags.how_chosen("gpu") == "by timing":
        print(
            "JAX has begun on the GPU with kernels chosen by timing, so this run is not bit-exact: "
            "call purerl.exact.set_xla_flags() before JAX's first computation."
        )
        return
    xla_flags.set_xla_flags()
    if "jax" in sys.modules:  # it read the environment when it was imported
        kept = xla_flags.os.environ.get(xla_flags.KEPT_TIMINGS)
        if kept is not None:
            sys.modules["jax"].config.update(xla_flags.KEPT_TIMINGS.lower(), kept)


def _runs_on_gpu() -> bool:
    jax = sys.modules.get("jax")
    if jax is None:
        return False
    from jax._src import xla_bridge  # JAX has no public way to ask without starting it

    return xla_bridge.backends_are_initialized() and jax.default_backend() == "gpu"


@contextmanager
def stop_signals(end: Callable[[int], Any]) -> Iterator[Callable[[], bool]]:
    """Turns SIGTERM and SIGINT into a request to stop.

    Args:
      end: called with an exit code at the second signal.

    Returns:
      A question: was a stop requested? Outside of the main thread, which alone receives signals,
      the answer is always no.
    """
    received: list[int] = []

    def handle(number: int, frame: Any) -> None:
        if received:
            end(128 + number)
            return
        received.append(number)
        print(
            f"\n{signal.Signals(number).name}: finishing this chunk, then saving. "
            "Once more to stop at once.",
            file=sys.stderr,
            flush=True,
        )

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    old = {number: signal.signal(number, handle) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)


def _interrupt(code: int) -> None:
    raise KeyboardInterrupt
