"""Trains one seed, or vmapped ones together, from the newest checkpoint that all of them have.

Vmapped seeds share one program; each has a folder like any other run, and they are saved and
resumed together, always at an update that all of them have on the disk.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from purerl.core.records import PyTree, TrainState
from purerl.devices import processes
from purerl.devices.processes import alone
from purerl.devices.programs import Programs
from purerl.runs import checkpoint, checkpoint_folder, console, loop, manifest, run_folder
from purerl.runs.files import read_json
from purerl.runs.loggers import BackgroundLogger, Say, TensorBoardSink, WandbSink, check_installed
from purerl.runs.video_process import RunVideo
from purerl.runs.writer import RunWriter

if TYPE_CHECKING:
    from purerl.runs.options import Options


def train_together(
    folders: list[Path],
    seeds: list[int],
    plan: loop.Plan,
    programs: Callable[[], Programs],
    abstract: PyTree,
    facts: dict[str, Any],
    options: "Options",
    loggers: list[Callable[..., BackgroundLogger]],
    stop: Callable[[], bool],
) -> None:
    """Trains one run, or vmapped ones, from the newest checkpoint that all of them have."""
    with ExitStack() as stack:
        progress: Any = processes.Silent()
        if processes.is_first():
            progress = stack.enter_context(console.progress(plan.updates))
        places = [folder / "checkpoints" for folder in folders]
        saved: list[checkpoint.Saved] = []

        def find() -> dict[str, Any]:
            saved.extend(find_saved(places, abstract, options.resume, progress.say))
            known = saved[0].meta if saved else {"wall_s": 0.0, "update": 0}
            return {name: known[name] for name in ("wall_s", "update")} | {"found": bool(saved)}

        meta = alone(find)
        if meta["update"] >= plan.updates:
            for one in saved:
                progress.say(f"Already done: {plan.updates} updates. Digest {one.meta['digest']}")
            return
        seconds = programs().seconds
        times = ", ".join(f"{name} {value:.1f} s" for name, value in seconds.items())
        progress.say(f"Compiled: {times}")
        state = first_state(meta.pop("found"), saved, seeds, programs(), abstract, progress.say)
        writers: list[Any] = [processes.Silent(folder) for folder in folders]
        if processes.is_first():
            with run_folder.refusals():
                writers = open_writers(folders, saved, options, progress.say)
            for folder, writer in zip(folders, writers, strict=True):
                stack.callback(writer.close)
                writer.loggers = [begin(folder, meta["update"], progress.say) for begin in loggers]
            if options.video:  # of the first seed: one such process is enough
                writers[0].loggers.append(RunVideo(folders[0], stop, progress.say))
        meta["fingerprint"] = manifest.fingerprint(facts)
        loop.train(
            plan,
            programs(),
            programs().spread(state),
            writers,
            progress,
            processes.agreed(stop),
            progress.say,
            meta,
        )
        for folder, writer in zip(folders, writers, strict=True):
            of = f" of {folder.name}" if options.num_seeds > 1 else ""
            progress.say(f"Done: {plan.steps:,} steps{of}. Digest {writer.digest}")


def find_saved(
    places: list[Path], abstract: PyTree, resume: bool, say: Say
) -> list[checkpoint.Saved]:
    """Returns the newest checkpoint that all `places` have, one each; [] if there is none yet."""
    saved = checkpoint.newest(places, abstract, say)
    if not saved:
        checkpoint_folder.check_none_lost(places)
        if resume:
            say(f"There is no checkpoint in {places[0]}: it begins anew.")
    return saved


def first_state(
    found: bool,
    saved: list[checkpoint.Saved],
    seeds: list[int],
    programs: Programs,
    abstract: PyTree,
    say: Say,
) -> TrainState:
    """Returns the state to begin with: new, or the `saved` one that the first process has found."""

    def together(trees: list[Any]) -> Any:
        return trees[0] if len(trees) == 1 else jax.tree.map(lambda *x: jnp.stack(x), *trees)

    if not found:
        return programs.init(together([jax.random.key(seed) for seed in seeds]))
    for one in saved:
        say(f"Resuming after update {one.meta['update']}. Digest {one.meta['digest']}")
    state = together([one.state for one in saved]) if saved else None
    return processes.state_of_first(state, abstract)


def open_writers(
    folders: list[Path], saved: list[checkpoint.Saved], options: "Options", say: Say
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


def needed_loggers(options: "Options") -> list[Callable[..., Any]]:
    """Returns functions that start the loggers asked for; UserError if a package is missing."""

    def tensorboard(folder: Path, update: int, say: Any) -> BackgroundLogger:
        return BackgroundLogger("TensorBoard", lambda: TensorBoardSink(folder, update), say)

    def wandb(folder: Path, update: int, say: Any) -> BackgroundLogger:
        name = read_json(folder / "manifest.json")["run_id"]
        settings = read_json(folder / "config.json")
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
