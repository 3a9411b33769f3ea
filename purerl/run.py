"""Trains an experiment: `python -m purerl.run EXPERIMENT [--seed 1] [--ppo.num-envs 64 ...]`.

EXPERIMENT is a name in experiments/, a path to a Python file, or a dotted module. Every setting of
the experiment can be overridden; `python -m purerl.run EXPERIMENT --help` lists them all.

The run is written to runs/<experiment>/<name>/; with --num-seeds S each seed has such a folder of
its own, <name>-seed<k>, which evaluate, render and compare take like any other.

Killed at any moment, the same command with --resume goes on from the last checkpoint to the same
result, bit for bit. SIGTERM and Ctrl-C save first; a second one stops at once.

Exit codes: 0 done, 1 the run cannot go on, 2 a mistake in the command, 3 stopped on request.
"""

import dataclasses
import os
import shlex
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from purerl import exact
from purerl.core.errors import USAGE, RunError, StoppedError, UserError
from purerl.runs import experiment
from purerl.runs.command_errors import leave, tell
from purerl.runs.experiment import Experiment, Source


@dataclass(frozen=True)
class Options:
    """How a run is made, kept and shown; only vmapped seeds and num_shards change its bits."""

    name: str | None = None
    """Name of the run, the folder under runs/<experiment>/ (default: seed<seed>)."""
    num_seeds: int = 1
    """Train this many seeds, from --seed upwards, each in a run's folder of its own."""
    seeds_by: Literal["vmap", "map"] = "vmap"
    """vmap: all in one program, with the statistics of single runs but other bits; map: one after
    another, with the bits of single runs."""
    num_shards: int = 0
    """Cut the environments into this many parts, a multiple of the devices that share them: on any
    number of devices the bits are the same. 0: a part for each device; 1: use one device."""
    distributed: str = ""
    """One of several processes that train together: auto (SLURM, Open MPI, ...), or
    HOST:PORT,NUM_PROCESSES,PROCESS_ID, HOST being that of process 0, which alone writes the run."""
    resume: bool = False
    """Go on from the last whole checkpoint of the run."""
    allow_changes: bool = False
    """Resume although settings, versions or device differ; written down in manifest.json."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    log_every: int = 0
    """Updates between two lines of metrics.jsonl; 0: chosen for about 500 lines."""
    checkpoints: int = 10
    """Checkpoints over the run, evenly spaced, the last one at the end."""
    keep: int = 3
    """Newest checkpoints to keep, besides the best one by evaluation."""
    tensorboard: bool = False
    """Write TensorBoard files too (needs purerl[tensorboard])."""
    wandb: Literal["off", "online", "offline"] = "off"
    """Send metrics to Weights & Biases too (needs purerl[wandb])."""
    wandb_project: str = "purerl"
    """The W&B project."""
    video: bool = False
    """Make a video at each evaluation, in a process of low priority (see purerl.render)."""
    cache: bool = True
    """Whether compiled programs are kept, in JAX_COMPILATION_CACHE_DIR, else in purerl/jax in
    XDG_CACHE_HOME or ~/.cache."""

    def __post_init__(self) -> None:
        """Checks the rules."""
        for name, least in _LEAST.items():
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {least}.")


_LEAST = {"num_seeds": 1, "num_shards": 0, "log_every": 0, "checkpoints": 0, "keep": 1}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(help_page())
        return 0 if arguments else USAGE
    try:
        command(arguments)
    except (UserError, RunError, StoppedError) as error:
        code = tell(error)
        if isinstance(error, StoppedError):
            print(f"Go on with: {resume_command(arguments)}", file=sys.stderr)
        return code
    return 0


def help_page() -> str:
    """Returns the page of `python -m purerl.run --help`, without importing JAX."""
    lines = [str(__doc__), "Experiments:"]
    named = experiment.available()
    width = max(map(len, named), default=0)
    lines += [f"  {name:{width}}  {experiment.summary(path)}" for name, path in named.items()]
    return "\n".join(lines if named else [*lines, "  none in experiments/"])


def resume_command(arguments: Sequence[str]) -> str:
    """Returns the command that goes on with an interrupted run."""
    more = [] if "--resume" in arguments else ["--resume"]
    return shlex.join(["python", "-m", "purerl.run", *arguments, *more])


def command(arguments: Sequence[str]) -> None:
    """Parses, prepares and trains."""
    exact.set_xla_flags()  # before JAX starts
    from purerl.devices.processes import fail_together
    from purerl.runs.command_line import parse
    from purerl.runs.session import execute

    if arguments[0].startswith("-"):
        raise UserError(
            f"The first word must be the experiment, not {arguments[0]!r}: "
            "python -m purerl.run EXPERIMENT [--option value ...]"
        )
    source = experiment.find(arguments[0])
    prog = f"python -m purerl.run {arguments[0]}"
    chosen, options = from_command_line(parse, source, arguments[1:], prog)
    with ExitStack() as stack:
        stop = stack.enter_context(stop_signals())
        stack.enter_context(fail_together())
        execute(source, runs_of(source, chosen, options), options, stop, stack)


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


def from_command_line(
    parse: Callable[..., Any], source: Source, arguments: Sequence[str], prog: str
) -> tuple[Experiment, Options]:
    """Returns the experiment with its overrides, and the run's options."""
    values = experiment.settings(source.experiment)
    kinds = {f.name: f.type for f in dataclasses.fields(Experiment)}
    fields = [
        (name, type(value) if dataclasses.is_dataclass(value) else kinds[name],
         dataclasses.field(kw_only=True))
        for name, value in values.items()
    ]  # fmt: skip
    # A class made for this experiment: its settings have the types of their values, which is all
    # that the command line needs to know, so an environment's options need no registration.
    both = dataclasses.make_dataclass("Settings", fields, bases=(Options,), frozen=True)
    both.__doc__ = experiment.summary(source.path) or f"Trains {source.name}."
    parsed = parse(both, arguments, prog, both(**values))
    overrides = {name: getattr(parsed, name) for name in values}
    options = {f.name: getattr(parsed, f.name) for f in dataclasses.fields(Options)}
    return dataclasses.replace(source.experiment, **overrides), Options(**options)


@contextmanager
def stop_signals() -> Any:
    """Turns SIGTERM and SIGINT into a request to stop, and a second one into an end at once."""
    received: list[int] = []

    def handle(number: int, frame: Any) -> None:
        if received:
            os._exit(128 + number)
        received.append(number)
        print(
            f"\n{signal.Signals(number).name}: finishing this chunk, then saving. "
            "Once more to stop at once.",
            file=sys.stderr,
            flush=True,
        )

    old = {number: signal.signal(number, handle) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)


if __name__ == "__main__":
    leave(main)
