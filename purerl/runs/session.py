"""Carries a run command out: prepares folders and programs, and has each seed trained.

A seed's folder is a run like any other. Seeds mapped one after another are runs one after another,
with the same compiled programs: their bits are those of single runs by construction. Vmapped seeds
share one program, whose bits depend on their number (`seeds.py`).
"""

import functools
import sys
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax

from purerl import exact
from purerl.core.errors import RunError, UserError
from purerl.core.records import PyTree
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
    loop,
    manifest,
    run_folder,
)
from purerl.runs.experiment import Experiment, Source
from purerl.runs.files import read_json
from purerl.runs.seed_group import needed_loggers, train_together

if TYPE_CHECKING:
    from purerl.runs.options import Options

MANY = 9  # edited files, which a refusal to resume then counts and does not list


def execute(
    source: Source,
    runs: dict[Path, Experiment],
    options: "Options",
    stop: Callable[[], bool],
    stack: ExitStack,
) -> None:
    """Prepares the folders and the programs, and trains.

    Args:
      source: where the experiment came from.
      runs: each seed's folder, and the experiment with its overrides.
      options: the run's options.
      stop: tells whether a signal asked to stop.
      stack: closes what is opened here.
    """
    chosen, vmapped = next(iter(runs.values())), vmapped_seeds(options)
    processes.start(options.distributed)
    alone(lambda: run_folder.check_new_or_resume(runs, options.resume))
    loggers = needed_loggers(options)
    cache = compilation.set_up_jax(options.cache)
    with compilation.no_collection():
        setup = build_experiment.build(chosen)
        abstract = abstract_state(*setup[:3])
    begun_with = alone(lambda: shards_on_disk(runs))
    shards = choose_shards(setup.config, abstract, options, begun_with)
    plan = loop.make_plan(setup.config, chosen.evaluation, options.checkpoints, options.log_every)
    schedule = {"log_every": plan.log_every, "checkpoints": options.checkpoints}
    facts = describe_process(chosen, setup, shards, vmapped)
    facts["experiment_file"] = str(source.path)

    def prepare() -> bool:
        for folder in runs:
            stack.enter_context(run_folder.lock(folder))
        run_folder.check_new_or_resume(runs, options.resume)  # again: another may have been here
        for folder, one in runs.items():
            settings = run_folder.describe(source, one, schedule)
            begin_or_go_on(folder, source, settings, facts, abstract, options.allow_changes)
        lines = console.describe_plan(plan, setup, abstract, facts, list(runs), cache)
        print("\n".join(lines), flush=True)
        return not all(checkpoint_folder.updates(folder / "checkpoints") for folder in runs)

    with run_folder.refusals():
        fresh = alone(prepare)

    @functools.cache
    def programs() -> Programs:
        calls_host = setup.engine == "c"
        with build_experiment.blame(setup.env):
            made = compile_programs(
                *setup[:3], chosen.evaluation, fresh, shards, vmapped, calls_host
            )
        if jax.default_backend() == "gpu" and processes.is_first():
            reasons = manifest.inexact_because(setup.engine, facts["kernels"], made.unordered)
            for folder in runs:
                run_folder.amend(folder, manifest.exactness(reasons))
            for place in made.unordered:
                print(f"Not bit-exact: nothing fixes the order of the sum {place}", flush=True)
        return made

    groups = [list(runs)] if vmapped > 1 else [[folder] for folder in runs]
    failed = []
    for folders in groups:
        seeds = [runs[folder].seed for folder in folders]
        try:
            train_together(folders, seeds, plan, programs, abstract, facts, options, loggers, stop)
        except RunError as error:  # the seeds after it can still be trained
            failed.append(str(error))
            if len(groups) > 1:  # they may take long, or be stopped
                print(f"purerl: {error}", file=sys.stderr, flush=True)
    if failed:
        raise RunError(" ".join(failed))


def describe_process(
    chosen: Experiment, setup: build_experiment.Setup, shards: Shards, vmapped: int
) -> dict[str, Any]:
    """Returns what the bits depend on besides the settings, as the manifest keeps it."""
    builders = (chosen.build_env, chosen.build_network)
    chosen_by = exact.how_chosen(jax.default_backend())
    facts = manifest.collect(setup.engine, builders, chosen_by, shards.number)
    facts["model"] = build_experiment.physics_hash(setup.env)
    if vmapped > 1:
        facts["vmapped_seeds"] = {"first": chosen.seed, "number": vmapped}
    return facts


def shards_on_disk(folders: Iterable[Path]) -> int:
    """Returns how many shards a run was begun with, 0 if there is none yet."""
    begun = [folder for folder in folders if (folder / "config.json").exists()]
    return read_json(begun[0] / "manifest.json").get("num_shards", 1) if begun else 0


def choose_shards(config: Config, abstract: PyTree, options: "Options", begun_with: int) -> Shards:
    """Returns the shards asked for, or those of the run that goes on, or one for each device.

    Raises:
      UserError: devices, shards, environments and minibatches do not divide as they must.
    """
    number, devices = options.num_shards or begun_with, jax.device_count()
    if vmapped_seeds(options) > 1:
        if number > 1:
            raise UserError(
                f"num_shards is {number}, and {options.num_seeds} vmapped seeds share one program "
                "on one device; use --seeds-by map, or leave out --num-shards."
            )
        number = 1
    number = number or devices
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


def vmapped_seeds(options: "Options") -> int:
    """Returns how many seeds share one program; 1 if each is trained by itself."""
    return options.num_seeds if options.seeds_by == "vmap" else 1


def begin_or_go_on(
    folder: Path,
    source: Source,
    settings: dict[str, Any],
    facts: dict[str, Any],
    abstract: PyTree,
    allow_changes: bool,
) -> None:
    """Describes a new run on disk, or checks that this process would continue the old one."""
    if not (folder / "config.json").exists():
        run_folder.start(folder, source, settings, facts)
        return
    found = run_folder.check_same(folder, source, settings, facts)
    if found and not allow_changes:
        pin = "device.threads"  # a CPU's bits depend on the size of XLA's thread pool
        threads = [line.split()[1] for line in found if line.startswith(pin)]
        found += [f"(NPROC={number} brings {pin} back)" for number in threads]
        edited = [line for line in found if line.startswith("source.")]
        if len(edited) > MANY:
            found = [line for line in found if line not in edited]
            found.append(f"source: {len(edited)} files, as of another version of purerl")
        raise UserError(
            f"The run {folder} was begun under other conditions, so it would not go on exactly:\n  "
            + "\n  ".join(found)
            + "\nGive the command it was begun with, train anew under another --name, or go on all "
            "the same with --allow-changes."
        )
    if found:
        checkpoint.check_fits(folder / "checkpoints", abstract)
        run_folder.accept_changes(folder, source, settings, facts, found)
