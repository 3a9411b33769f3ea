"""Trains the seeds of a command: vmapped ones together, others one after another.

Seeds mapped one after another are runs one after another, with the same compiled programs: their
bits are those of single runs by construction. Vmapped seeds share one program, whose bits depend on
their number. They are saved and resumed together, always at an update that all of them have on the
disk.
"""

import functools
import hashlib
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from purerl.checks import examine_env, user_code
from purerl.core.errors import RunError, UserError
from purerl.core.records import PyTree, TrainState
from purerl.devices import processes
from purerl.devices.processes import in_first_process, kept_by_first
from purerl.devices.programs import Programs, compile_programs
from purerl.devices.shards import Shards
from purerl.experiment import definition, objects
from purerl.experiment.options import RunOptions
from purerl.machine import command_errors, files, output
from purerl.machine.lock import FolderLock
from purerl.machine.state_arrays import flatten, leaf_paths, raw, unflatten
from purerl.ppo.algorithm import start_stage
from purerl.runs import checkpoint, checkpoint_folder, manifest, resume
from purerl.runs.folder import CHECKPOINTS, Folder, check_manifest, note
from purerl.runs.metrics_file import MetricsFile, Record, keep_whole_lines
from purerl.runs.taken_parts import put_in
from purerl.training import console, loggers, loop
from purerl.training.plan import Plan
from purerl.training.writer import RunWriter

NO_CHECKPOINT: dict[str, Any] = {"wall_s": 0.0, "update": 0, "metrics_bytes": 0}
NO_CHECKPOINT |= {"metrics_sha256": hashlib.sha256().hexdigest()}


class Call(NamedTuple):
    """The command, or `train`, that trains."""

    began: float  # by `time.perf_counter` [s]: where `wall_s` is 0
    stop: Callable[[], bool]  # tells whether a signal asked to stop
    listener: Callable[[Record], Any] | None = None  # called with each line of metrics


class Job(NamedTuple):
    """What the seeds of one command have in common; no disk is read for it."""

    options: RunOptions
    chosen: definition.Experiment  # of the first seed
    setup: objects.Setup
    abstract: PyTree  # shapes of one seed's state
    shards: Shards
    plan: Plan
    facts: dict[str, Any]  # what manifest.json says of a run that begins now
    call: Call
    taken: dict[str, Any] | None  # of other runs, for the first state; in the first process


class Seed(NamedTuple):
    """One run of the command. Only the first process knows what its folder holds."""

    path: Path
    number: int
    folder: Folder | None = None
    lock: FolderLock | None = None


def train_all(job: Job, seeds: list[Seed]) -> None:
    """Trains vmapped seeds together, and others one after another; RunError if one failed."""
    fresh = in_first_process(lambda: not all(s.folder and s.folder.updates for s in seeds))
    programs = functools.cache(lambda: _compile(job, fresh))
    groups = [[seed] for seed in seeds] if job.options.vmapped_seeds == 1 else [seeds]
    failed, began = [], job.call.began
    for group in groups:
        try:
            _train_together(job, group, programs, began)
        except RunError as error:  # the seeds after it can still be trained
            failed.append(str(error))
            if len(groups) > 1:  # they may take long, or be stopped
                command_errors.tell(error)
        began = time.perf_counter()  # the next one's clock begins
    if failed:
        raise RunError(" ".join(failed))


def _compile(job: Job, fresh: bool) -> Programs:
    """Compiles the programs, `init` among them for a fresh run; prints what is not exact."""
    setup = job.setup
    with objects.naming_broken_rules(setup.env):
        programs = compile_programs(
            *setup[:3], job.chosen.evaluation, fresh, job.shards, job.options.vmapped_seeds,
            calls_host=setup.engine == "c",
        )  # fmt: skip
    if processes.is_first():
        for place in _unordered(programs):
            output.say(f"Not bit-exact: nothing fixes the order of the sum {place}")
    return programs


def _unordered(programs: Programs) -> list[str]:
    """Returns the sums whose order nothing fixes: on a CPU it is fixed."""
    return programs.unordered if jax.default_backend() == "gpu" else []


def _train_together(
    job: Job, seeds: list[Seed], programs: Callable[[], Programs], began: float
) -> None:
    """Trains one run, or vmapped ones, from the newest checkpoint that all of them have."""
    with ExitStack() as stack:
        progress: Any = processes.Silent()
        if processes.is_first():
            progress = stack.enter_context(console.progress(job.plan.updates))
        say = progress.say
        saved = kept_by_first(files.writing()(lambda: _newest(job, seeds, say))) or []
        last = saved[0].meta if saved else NO_CHECKPOINT
        about = {name: last[name] for name in ("wall_s", "update")}
        found, meta = in_first_process(lambda: (bool(saved), about))
        if meta["update"] >= job.plan.updates:
            for one in saved:
                say(f"Already done: {job.plan.updates} updates. Digest {one.meta['digest']}")
            return
        compiled = programs()
        times = ", ".join(f"{name} {value:.1f} s" for name, value in compiled.seconds.items())
        say(f"Compiled: {times}")
        for one in saved:
            say(f"Resuming after update {one.meta['update']}. Digest {one.meta['digest']}")
        state = _first_state(found, saved, seeds, job, compiled)
        for finding in examine_env.first_state(state.env_state) if not found else ():
            say(str(finding))
        writers: list[Any] = [processes.Silent(seed.path / CHECKPOINTS) for seed in seeds]
        if processes.is_first():
            with files.writing():
                exactness = manifest.with_unordered(job.facts, _unordered(compiled))
                seeds = [s._replace(folder=note(s.folder, **exactness)) for s in seeds if s.folder]
                writers = _open_writers(seeds, saved, job, say)
            for writer in writers:
                stack.callback(writer.close)
                writer.loggers = loggers.open_loggers(job.options, writer.folder, say)
        best = in_first_process(lambda: [writer.best() for writer in writers])
        stop = processes.agreed(job.call.stop)
        with user_code.program_errors():
            state = compiled.spread(state)
            meta |= {"wall_s": meta["wall_s"] + time.perf_counter() - began}
            told = job.call.listener
            loop.train(job.plan, compiled, state, writers, progress, stop, meta, best, told)
        for seed, writer in zip(seeds, writers, strict=True):
            of = f" of {seed.path.name}" if job.options.num_seeds > 1 else ""
            say(f"Done: {job.plan.steps:,} steps{of}. Digest {writer.digest}")


def _newest(job: Job, seeds: list[Seed], say: output.Say) -> list[checkpoint.Saved]:
    """Reads the newest checkpoint that all seeds have; [] where they begin.

    Raises:
      UserError: there were checkpoints, and none is whole.
    """
    folders = [seed.folder for seed in seeds if seed.folder]
    places = [folder.checkpoints for folder in folders]
    facts = list(map(check_manifest, folders))
    saved = checkpoint.newest(places, job.abstract, say, owners=list(map(manifest.owners, facts)))
    if not saved:
        promised = any(one.get("had_checkpoint") for one in facts)
        checkpoint_folder.check_none_lost(places, promised)
        if job.options.resume is True:
            say(f"There is no checkpoint in {places[0]}: it begins anew.")
    return saved


def _first_state(
    found: bool, saved: list[checkpoint.Saved], seeds: list[Seed], job: Job, programs: Programs
) -> TrainState:
    """Returns the state to begin with: new, or the `saved` one that the first process has found."""

    def together(trees: list[Any]) -> Any:
        return trees[0] if len(trees) == 1 else jax.tree.map(lambda *x: jnp.stack(x), *trees)

    if not found:
        drawn = programs.init(together([jax.random.key(seed.number) for seed in seeds]))
        return _of_first(put_in(drawn, job.taken or {}), job.abstract)
    state = together(list(map(_as_it_goes_on, seeds, saved))) if saved else None
    return _of_first(state, job.abstract)


def _of_first(state: TrainState | None, abstract: PyTree) -> Any:
    """Returns the first process's state, bit for bit; the others may give None."""
    if jax.process_count() == 1:
        return state
    shapes = zip(leaf_paths(abstract), jax.tree.leaves(jax.eval_shape(raw, abstract)), strict=True)
    mine = flatten(state) if state else {path: np.zeros(x.shape, x.dtype) for path, x in shapes}
    return unflatten(processes.of_first(mine), abstract)


def _as_it_goes_on(seed: Seed, saved: checkpoint.Saved) -> TrainState:
    """Returns a saved state; where a stage begins, ready for its reward."""
    begins = seed.folder and resume.begins_stage(seed.folder, saved.meta["update"])
    return start_stage(saved.state) if begins else saved.state


def _open_writers(
    seeds: list[Seed], saved: list[checkpoint.Saved], job: Job, say: output.Say
) -> list[RunWriter]:
    """Opens what writes each seed's folder, cut back to the checkpoints `saved`."""
    worker = ThreadPoolExecutor(1, "purerl-writer")
    together = [seed.path / CHECKPOINTS for seed in seeds]
    metas = [one.meta for one in saved] or [NO_CHECKPOINT] * len(seeds)
    opened = []
    for seed, meta in zip(seeds, metas, strict=True):
        assert seed.folder and seed.lock
        file = _open_metrics(seed.folder, meta, job.options.allow_changes, say)
        opened.append((*file, seed.lock))
    for place in together:
        checkpoint_folder.forget_after(place, metas[0]["update"])
    return [RunWriter(*one, job.options.keep, say, worker, together) for one in opened]


def _open_metrics(
    folder: Folder, meta: Record, allow_changes: bool, say: output.Say
) -> tuple[Folder, MetricsFile]:
    """Opens metrics.jsonl where a checkpoint left it; UserError if it is not what it was."""
    try:
        return folder, MetricsFile(folder.metrics, meta["metrics_bytes"], meta["metrics_sha256"])
    except UserError:
        if not allow_changes:
            raise
    change = f"{folder.metrics.name}: it was not what the run wrote; its whole lines are kept"
    say(change)
    place = keep_whole_lines(folder.metrics, meta["update"])
    folder = note(folder, **resume.with_change(folder.manifest, meta["update"], [change]))
    return folder, MetricsFile(folder.metrics, *place)
