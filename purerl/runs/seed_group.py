"""Trains one seed, or vmapped ones together, from the newest checkpoint that all of them have.

Vmapped seeds share one program; each has a folder like any other run, and they are saved and
resumed together, always at an update that all of them have on the disk.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.records import PyTree, TrainState
from purerl.devices import processes
from purerl.devices.processes import alone
from purerl.devices.programs import Programs
from purerl.runs import checkpoint, checkpoint_folder, console, loop, manifest, run_folder
from purerl.runs.loggers import Say, open_loggers
from purerl.runs.options import Options
from purerl.runs.writer import RunWriter


class Job(NamedTuple):
    """What the seeds of one command have in common."""

    options: Options
    plan: loop.Plan
    programs: Callable[[], Programs]  # compiles them when it is first called
    abstract: PyTree  # shapes of one seed's state
    facts: dict[str, Any]  # of manifest.json
    stop: Callable[[], bool]  # tells whether a signal asked to stop


def train_together(job: Job, folders: list[Path], seeds: list[int]) -> None:
    """Trains one run, or vmapped ones, from the newest checkpoint that all of them have.

    Args:
      job: what to do.
      folders: of the runs.
      seeds: their seeds.
    """
    plan = job.plan
    with ExitStack() as stack:
        progress: Any = processes.Silent()
        if processes.is_first():
            progress = stack.enter_context(console.progress(plan.updates))
        say, saved = progress.say, list[checkpoint.Saved]()
        places = [folder / "checkpoints" for folder in folders]

        def find() -> dict[str, Any]:
            saved.extend(checkpoint.newest(places, job.abstract, say))
            if not saved:
                checkpoint_folder.check_none_lost(places)
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
        state = _first_state(found, saved, seeds, programs, job.abstract)
        writers: list[Any] = [processes.Silent(folder) for folder in folders]
        if processes.is_first():
            with run_folder.refusals():
                writers = _open_writers(folders, saved, job.options, say)
            for folder, writer in zip(folders, writers, strict=True):
                stack.callback(writer.close)
                writer.loggers = open_loggers(job.options, folder, meta["update"], say)
        meta["fingerprint"] = manifest.fingerprint(job.facts)
        stop = processes.agreed(job.stop)
        loop.train(plan, programs, programs.spread(state), writers, progress, stop, meta)
        for folder, writer in zip(folders, writers, strict=True):
            of = f" of {folder.name}" if job.options.num_seeds > 1 else ""
            say(f"Done: {plan.steps:,} steps{of}. Digest {writer.digest}")


def _first_state(
    found: bool,
    saved: list[checkpoint.Saved],
    seeds: list[int],
    programs: Programs,
    abstract: PyTree,
) -> TrainState:
    """Returns the state to begin with: new, or the `saved` one that the first process has found."""

    def together(trees: list[Any]) -> Any:
        return trees[0] if len(trees) == 1 else jax.tree.map(lambda *x: jnp.stack(x), *trees)

    if not found:
        return programs.init(together([jax.random.key(seed) for seed in seeds]))
    state = together([one.state for one in saved]) if saved else None
    return processes.state_of_first(state, abstract)


def _open_writers(
    folders: list[Path], saved: list[checkpoint.Saved], options: Options, say: Say
) -> list[RunWriter]:
    """Opens what writes each seed's folder, cut back to the checkpoints `saved`."""
    worker = ThreadPoolExecutor(1, "purerl-writer")
    together = [folder / "checkpoints" for folder in folders]
    for place in together:
        checkpoint_folder.forget_after(place, saved[0].meta["update"] if saved else 0)
    offsets = [one.meta["metrics_bytes"] for one in saved] or [0] * len(folders)
    return [
        RunWriter(folder, offset, options.keep, say, worker, together)
        for folder, offset in zip(folders, offsets, strict=True)
    ]
