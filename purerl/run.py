"""Trains an experiment: `python -m purerl.run EXPERIMENT [--seed 1] [--ppo.num-envs 64 ...]`.

EXPERIMENT is a name in experiments/, a path to a Python file, or a dotted module. Every setting of
the experiment can be overridden; `python -m purerl.run EXPERIMENT --help` lists them all.

The run is written to runs/<experiment>/<name>/. Killed at any moment, the same command with
--resume goes on from the last checkpoint to the same result, bit for bit. SIGTERM and Ctrl-C save
first; a second one stops at once.

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

from purerl import experiment
from purerl.errors import USAGE, RunError, StoppedError, UserError
from purerl.experiment import Experiment, Source


@dataclass(frozen=True)
class Options:
    """How a run is kept and shown; nothing here changes what is learned."""

    name: str | None = None
    """Name of the run, the folder under runs/<experiment>/ (default: seed<seed>)."""
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
    """Keep compiled programs in JAX_COMPILATION_CACHE_DIR, or in ~/.cache/purerl/jax."""

    def __post_init__(self) -> None:
        """Checks the rules."""
        for name, least in (("log_every", 0), ("checkpoints", 0), ("keep", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {least}.")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(help_page())
        return 0 if arguments else USAGE
    try:
        command(arguments)
    except (UserError, RunError, StoppedError) as error:
        print(f"purerl: {error}", file=sys.stderr)
        if isinstance(error, StoppedError):
            print(f"Go on with: {resume_command(arguments)}", file=sys.stderr)
        return error.exit_code
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
    from purerl.cli import parse

    if arguments[0].startswith("-"):
        raise UserError(
            f"The first word must be the experiment, not {arguments[0]!r}: "
            "python -m purerl.run EXPERIMENT [--option value ...]"
        )
    source = experiment.find(arguments[0])
    prog = f"python -m purerl.run {arguments[0]}"
    chosen, options = from_command_line(parse, source, arguments[1:], prog)
    folder = options.runs / source.name / (options.name or f"seed{chosen.seed}")
    with ExitStack() as stack:
        stop = stack.enter_context(stop_signals())
        execute(source, chosen, options, folder, stop, stack)


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


def execute(
    source: Source,
    chosen: Experiment,
    options: Options,
    folder: Path,
    stop: Callable[[], bool],
    stack: ExitStack,
) -> None:
    """Prepares the folder, the programs and the first state, and trains.

    Args:
      source: where the experiment came from.
      chosen: the experiment with its overrides.
      options: the run's options.
      folder: the run's.
      stop: tells whether a signal asked to stop.
      stack: closes what is opened here.
    """
    from purerl import checkpoint, console, manifest, rundir, train
    from purerl.run_video import RunVideo

    rundir.check_new_or_resume(folder, options.resume)
    loggers = needed_loggers(options)
    cache = set_up_jax(options.cache)
    setup = rundir.build(chosen)
    plan = train.make_plan(setup.config, chosen.evaluation, options.checkpoints, options.log_every)
    schedule = {"log_every": plan.log_every, "checkpoints": options.checkpoints}
    settings = rundir.describe(source, chosen, schedule)
    facts = manifest.collect(setup.engine, (chosen.build_env, chosen.build_network))
    stack.enter_context(rundir.lock(folder))
    rundir.check_new_or_resume(folder, options.resume)  # again: another process may have been here
    begin_or_go_on(folder, source, settings, facts, options.allow_changes)

    progress = stack.enter_context(console.progress(plan.updates))
    abstract = train.abstract_state(*setup[:3])
    for line in console.describe_plan(plan, setup, abstract, facts, folder, cache):
        progress.say(line)
    saved = checkpoint.newest(folder / "checkpoints", abstract, progress.say)
    if saved is not None and saved.meta["update"] >= plan.updates:
        progress.say(f"Already done: {plan.updates} updates. Digest {saved.meta['digest']}")
        return
    programs = train.compile_programs(*setup[:3], chosen.evaluation, fresh=saved is None)
    times = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in programs.seconds.items())
    progress.say(f"Compiled: {times}")
    state, recorder, meta = first_state(saved, programs, chosen, options, folder, progress.say)
    stack.callback(recorder.close)
    recorder.loggers = [start(folder, settings, meta["update"], progress.say) for start in loggers]
    if options.video:
        recorder.loggers.append(RunVideo(folder, stop, progress.say))
    meta["fingerprint"] = manifest.fingerprint(facts)
    train.train(plan, programs, state, recorder, progress, stop, progress.say, meta)
    progress.say(f"Done: {plan.steps:,} steps. Digest {recorder.digest}")


def first_state(
    saved: Any, programs: Any, chosen: Experiment, options: Options, folder: Path, say: Any
) -> tuple[Any, Any, dict[str, Any]]:
    """Returns the state to begin with, the recorder, and what is known of earlier lives."""
    import jax

    from purerl.recorder import Recorder

    if saved is None:
        recorder = Recorder(folder, 0, options.keep, [], say)
        return programs.init(jax.random.key(chosen.seed)), recorder, {"wall_s": 0.0, "update": 0}
    recorder = Recorder(folder, saved.meta["metrics_bytes"], options.keep, [], say)
    say(f"Resuming after update {saved.meta['update']}. Digest {saved.meta['digest']}")
    known = {name: saved.meta[name] for name in ("wall_s", "update")}
    return saved.state, recorder, known


def begin_or_go_on(
    folder: Path,
    source: Source,
    settings: dict[str, Any],
    facts: dict[str, Any],
    allow_changes: bool,
) -> None:
    """Describes a new run on disk, or checks that this process would continue the old one."""
    from purerl import rundir

    if not (folder / "config.json").exists():
        rundir.start(folder, source, settings, facts)
        return
    found = rundir.check_same(folder, source, settings, facts)
    if found and not allow_changes:
        pin = "device.threads"  # a CPU's bits depend on the size of XLA's thread pool
        threads = [line.split()[1] for line in found if line.startswith(pin)]
        found += [f"(NPROC={number} brings {pin} back)" for number in threads]
        raise UserError(
            f"The run {folder} was begun under other conditions, so it would not go on exactly:\n  "
            + "\n  ".join(found)
            + "\nGive the command it was begun with, or --allow-changes to go on all the same."
        )
    if found:
        rundir.accept_changes(folder, source, settings, facts, found)


def needed_loggers(options: Options) -> list[Callable[..., Any]]:
    """Returns functions that start the loggers asked for; UserError if a package is missing."""
    from purerl.loggers import (
        BackgroundLogger,
        TensorBoardSink,
        WandbSink,
        check_installed,
    )

    def tensorboard(folder: Path, settings: dict, update: int, say: Any) -> BackgroundLogger:
        return BackgroundLogger("TensorBoard", lambda: TensorBoardSink(folder, update), say)

    def wandb(folder: Path, settings: dict, update: int, say: Any) -> BackgroundLogger:
        from purerl.rundir import read_json

        name = read_json(folder / "manifest.json")["run_id"]
        return BackgroundLogger(
            "W&B",
            lambda: WandbSink(folder, options.wandb, options.wandb_project, name, settings),
            say,
        )

    starts: list[Callable[..., Any]] = []
    if options.tensorboard:
        check_installed("tensorboardX", "tensorboard")
        starts.append(tensorboard)
    if options.wandb != "off":
        check_installed("wandb", "wandb")
        starts.append(wandb)
    return starts


def set_up_jax(cache: bool) -> str:
    """Sets what bits depend on, whatever a later JAX's defaults; returns the cache's folder."""
    import jax

    jax.config.update("jax_threefry_partitionable", True)
    jax.config.update("jax_default_prng_impl", "threefry2x32")
    if not cache:
        jax.config.update("jax_enable_compilation_cache", False)
        return "off"
    # JAX has read JAX_COMPILATION_CACHE_DIR by now, if it is set.
    folder = jax.config.values["jax_compilation_cache_dir"]
    folder = folder or str(Path.home() / ".cache" / "purerl" / "jax")
    jax.config.update("jax_compilation_cache_dir", folder)
    return folder


if __name__ == "__main__":
    sys.exit(main())
