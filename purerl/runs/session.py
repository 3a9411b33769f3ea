"""Carries a run command out: prepares folders and programs, and trains each seed.

A seed's folder is a run like any other. Seeds mapped one after another are runs one after another,
with the same compiled programs: their bits are those of single runs by construction. Vmapped seeds
share one program, whose bits depend on their number. They are saved and resumed together, always at
an update that all of them have on the disk.
"""

import functools
import hashlib
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from purerl import exact
from purerl.core.errors import RunError, UserError
from purerl.core.records import PyTree, TrainState
from purerl.devices import compilation, processes
from purerl.devices.check_sizes import check_minibatches, check_shards
from purerl.devices.processes import alone
from purerl.devices.programs import Programs, abstract_state, compile_programs
from purerl.devices.shards import Shards
from purerl.ppo.config import Config
from purerl.ppo.learner import is_recurrent
from purerl.runs import (
    build_experiment,
    checkpoint,
    checkpoint_folder,
    console,
    identity,
    loop,
    manifest,
    output,
    run_folder,
)
from purerl.runs.build_experiment import Setup
from purerl.runs.command_errors import tell
from purerl.runs.examine_env import tell_first
from purerl.runs.experiment import Experiment, Source
from purerl.runs.files import read_json, write_json
from purerl.runs.lock import RunLock
from purerl.runs.loggers import Say, check_loggers, open_loggers
from purerl.runs.metrics_file import MetricsFile, Record, keep_whole_lines
from purerl.runs.options import Options
from purerl.runs.user_code import running
from purerl.runs.writer import RunWriter

NO_CHECKPOINT = {"update": 0, "metrics_bytes": 0, "metrics_sha256": hashlib.sha256().hexdigest()}


class _Job(NamedTuple):
    """What the seeds of one command have in common."""

    options: Options
    plan: loop.Plan
    programs: Callable[[], Programs]  # compiles them when it is first called
    abstract: PyTree  # shapes of one seed's state
    locks: dict[Path, RunLock]  # of the folders; in the first process only
    stop: Callable[[], bool]  # tells whether a signal asked to stop


def execute(
    source: Source, runs: dict[Path, Experiment], options: Options, stop: Callable[[], bool]
) -> None:
    """Prepares the folders and the programs, and trains.

    Args:
      source: where the experiment came from.
      runs: each seed's folder, and the experiment with its overrides.
      options: the run's options.
      stop: tells whether a signal asked to stop.
    """
    chosen = next(iter(runs.values()))
    check = run_folder.refusals()(run_folder.check_new_or_resume)
    with processes.fail_together(), ExitStack() as stack:
        processes.start(options.distributed)
        alone(lambda: check(runs, options.resume))
        check_loggers(options)
        cache = compilation.set_up_jax(options.cache)
        with compilation.no_collection():
            setup = build_experiment.build(chosen)
            abstract = abstract_state(*setup[:3])
        begun_with = alone(lambda: _shards_on_disk(runs))
        shards = _choose_shards(setup.config, abstract, options, begun_with)
        build_experiment.check_memory(setup, abstract, options.vmapped_seeds, shards.devices)
        plan = loop.make_plan(
            setup.config, chosen.evaluation, options.checkpoints, options.log_every
        )
        schedule = {"log_every": plan.log_every, "checkpoints": options.checkpoints}
        facts = _facts(source, chosen, options, setup, shards)
        locks: dict[Path, RunLock] = {}

        @run_folder.refusals()
        def prepare() -> bool:
            for folder in runs:
                locks[folder] = RunLock(folder)
                stack.callback(locks[folder].close)
            check(runs, options.resume)  # another may have been here
            begun = any(map(run_folder.is_begun, runs))
            for folder, one in runs.items():
                settings = run_folder.describe(source, one, schedule)
                run_folder.begin_or_go_on(
                    folder, source, settings, facts, abstract, options.allow_changes, begun
                )
            for line in console.describe_plan(plan, setup, abstract, facts, list(runs), cache):
                output.say(line)
            return not all(checkpoint_folder.updates(folder / "checkpoints") for folder in runs)

        fresh = alone(prepare)

        @functools.cache
        def programs() -> Programs:
            with build_experiment.blame(setup.env):
                made = compile_programs(
                    *setup[:3], chosen.evaluation, fresh, shards, options.vmapped_seeds,
                    calls_host=setup.engine == "c",
                )  # fmt: skip
            if jax.default_backend() == "gpu" and processes.is_first():
                exactness = manifest.with_unordered(facts, made.unordered)
                _tell_unordered(runs, exactness, made.unordered)
            return made

        _train_all(runs, _Job(options, plan, programs, abstract, locks, stop))


def _facts(
    source: Source, chosen: Experiment, options: Options, setup: Setup, shards: Shards
) -> dict[str, Any]:
    """Returns what manifest.json says of a run that begins now."""
    builders = (chosen.build_env, chosen.build_network)
    kernels = exact.how_chosen(jax.default_backend())
    inexact = getattr(setup.env, "inexact", "")
    facts = manifest.collect(setup.engine, builders, kernels, shards.number, inexact)
    facts["model"] = build_experiment.physics_hash(setup.env)
    facts["experiment_file"] = str(source.path)
    if options.vmapped_seeds > 1:
        facts["vmapped_seeds"] = {"first": chosen.seed, "number": options.vmapped_seeds}
    return facts


def _tell_unordered(folders: Iterable[Path], exactness: dict[str, Any], places: list[str]) -> None:
    """Adds to manifest.json, and prints, what is known only when programs are compiled."""
    for folder in folders:
        path = folder / "manifest.json"
        write_json(path, read_json(path) | exactness)
    for place in places:
        output.say(f"Not bit-exact: nothing fixes the order of the sum {place}")


@run_folder.refusals()
def _shards_on_disk(folders: Iterable[Path]) -> int:
    """Returns how many shards a run was begun with, 0 if there is none yet."""
    begun = [folder for folder in folders if run_folder.is_begun(folder)]
    return manifest.read(begun[0])["num_shards"] if begun else 0


def _choose_shards(config: Config, abstract: PyTree, options: Options, begun_with: int) -> Shards:
    """Returns the shards asked for, or those of the run that goes on, or one for each device."""
    number, devices = options.num_shards or begun_with, jax.device_count()
    options.check_vmapped(number)
    number = 1 if options.vmapped_seeds > 1 else number or devices
    if number == 1 and jax.process_count() > 1:
        raise UserError(
            f"num_shards is 1, which one device computes, and there are {jax.process_count()} "
            f"processes with {devices} devices; leave out --distributed, or cut the environments "
            f"with --num-shards {devices}."
        )
    shards = Shards(number, devices if number > 1 else 1)
    try:
        check_shards(shards, config.num_envs)
        name = "num_envs / num_shards" if number > 1 else "num_envs"
        check_minibatches(config, is_recurrent(abstract.carry), config.num_envs // number, name)
    except ValueError as error:
        raise UserError(str(error)) from error
    return shards


def _train_all(runs: dict[Path, Experiment], job: _Job) -> None:
    """Trains vmapped seeds together, and others one after another; RunError if one failed."""
    groups = [[folder] for folder in runs] if job.options.vmapped_seeds == 1 else [list(runs)]
    failed = []
    for folders in groups:
        try:
            _train_together(job, folders, [runs[folder].seed for folder in folders])
        except RunError as error:  # the seeds after it can still be trained
            failed.append(str(error))
            if len(groups) > 1:  # they may take long, or be stopped
                tell(error)
    if failed:
        raise RunError(" ".join(failed))


def _train_together(job: _Job, folders: list[Path], seeds: list[int]) -> None:
    """Trains one run, or vmapped ones, from the newest checkpoint that all of them have."""
    plan = job.plan
    with ExitStack() as stack:
        progress: Any = processes.Silent()
        if processes.is_first():
            progress = stack.enter_context(console.progress(plan.updates))
        say, saved = progress.say, list[checkpoint.Saved]()
        places = [folder / "checkpoints" for folder in folders]

        @run_folder.refusals()
        def find() -> dict[str, Any]:
            facts = list(map(manifest.read, folders))
            owners = list(map(identity.owners, facts))
            saved.extend(checkpoint.newest(places, job.abstract, say, owners=owners))
            if not saved:
                checkpoint_folder.check_none_lost(
                    places, any(f.get("had_checkpoint") for f in facts)
                )
                if job.options.resume:
                    say(f"There is no checkpoint in {places[0]}: it begins anew.")
            known = saved[0].meta if saved else {"wall_s": 0.0, "update": 0}
            return {name: known[name] for name in ("wall_s", "update")} | {"found": bool(saved)}

        meta = alone(find)
        found = meta.pop("found")
        if meta["update"] >= plan.updates:
            for one in saved:
                say(f"Already done: {plan.updates} updates. Digest {one.meta['digest']}")
            return
        programs = job.programs()
        times = ", ".join(f"{name} {value:.1f} s" for name, value in programs.seconds.items())
        say(f"Compiled: {times}")
        for one in saved:
            say(f"Resuming after update {one.meta['update']}. Digest {one.meta['digest']}")
        state = _first_state(found, saved, seeds, job)
        tell_first(None if found else state.env, say)
        writers: list[Any] = [processes.Silent(folder) for folder in folders]
        if processes.is_first():
            with run_folder.refusals():
                writers = _open_writers(folders, saved, job, say)
            for folder, writer in zip(folders, writers, strict=True):
                stack.callback(writer.close)
                writer.loggers = open_loggers(job.options, folder, meta["update"], say)
        stop = processes.agreed(job.stop)
        with running():
            loop.train(plan, programs, programs.spread(state), writers, progress, stop, meta)
        for folder, writer in zip(folders, writers, strict=True):
            of = f" of {folder.name}" if job.options.num_seeds > 1 else ""
            say(f"Done: {plan.steps:,} steps{of}. Digest {writer.digest}")


def _first_state(
    found: bool, saved: list[checkpoint.Saved], seeds: list[int], job: _Job
) -> TrainState:
    """Returns the state to begin with: new, or the `saved` one that the first process has found."""

    def together(trees: list[Any]) -> Any:
        return trees[0] if len(trees) == 1 else jax.tree.map(lambda *x: jnp.stack(x), *trees)

    if not found:
        return job.programs().init(together([jax.random.key(seed) for seed in seeds]))
    state = together([one.state for one in saved]) if saved else None
    return processes.state_of_first(state, job.abstract)


def _open_writers(
    folders: list[Path], saved: list[checkpoint.Saved], job: _Job, say: Say
) -> list[RunWriter]:
    """Opens what writes each seed's folder, cut back to the checkpoints `saved`."""
    worker = ThreadPoolExecutor(1, "purerl-writer")
    together = [folder / "checkpoints" for folder in folders]
    metas = [one.meta for one in saved] or [NO_CHECKPOINT] * len(folders)
    files = [
        _open_metrics(folder, meta, job.options.allow_changes, say)
        for folder, meta in zip(folders, metas, strict=True)
    ]
    for place in together:
        checkpoint_folder.forget_after(place, metas[0]["update"])
    return [
        RunWriter(
            job.locks[folder], file, run_folder.signature(folder), job.options.keep, say, worker,
            together,
        )
        for folder, file in zip(folders, files, strict=True)
    ]  # fmt: skip


def _open_metrics(folder: Path, meta: Record, allow_changes: bool, say: Say) -> MetricsFile:
    """Opens metrics.jsonl where a checkpoint left it; UserError if it is not what it was."""
    path = folder / "metrics.jsonl"
    try:
        return MetricsFile(path, meta["metrics_bytes"], meta["metrics_sha256"])
    except UserError:
        if not allow_changes:
            raise
    change = f"{path.name}: it was not what the run wrote; its whole lines are kept"
    say(change)
    place = keep_whole_lines(path, meta["update"])
    run_folder.note_change(folder, meta["update"], change)
    return MetricsFile(path, *place)
