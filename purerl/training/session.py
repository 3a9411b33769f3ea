"""Carries a run command out: prepares programs and folders, then lets `seeds` train.

A seed's folder is a run like any other. It is read when the command begins, and once more when its
lock is held, since another process may have been there in between.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import jax

from purerl import exact
from purerl.checks import check_env
from purerl.checks.held_arrays import hash_held
from purerl.checks.user_code import users_errors
from purerl.core.errors import UserError
from purerl.core.records import PyTree
from purerl.devices import compilation, processes, programs
from purerl.devices.check_sizes import check_minibatches, check_shards
from purerl.devices.processes import in_first_process, kept_by_first
from purerl.devices.shards import Shards
from purerl.experiment import objects
from purerl.experiment.definition import Experiment
from purerl.experiment.loading import Source
from purerl.experiment.options import RunOptions
from purerl.machine import files, output
from purerl.machine.lock import FolderLock
from purerl.ppo.config import Config
from purerl.ppo.learner import is_recurrent
from purerl.runs import checkpoint, folder as run_folder, manifest, resume
from purerl.runs.folder import Folder, check_manifest
from purerl.runs.taken_parts import read_parts
from purerl.training import console, loggers
from purerl.training.plan import make_plan
from purerl.training.seeds import Call, Job, Seed, train_all

Runs = dict[Path, Experiment]  # each seed's folder, and the experiment with its overrides


def execute(
    source: Source, runs: Runs, found: Sequence[Folder], options: RunOptions, call: Call
) -> None:
    """Prepares the folders and the programs, and trains.

    Args:
      source: where the experiment came from.
      runs: what is to be trained.
      found: what each folder held when the command began.
      options: the run's options.
      call: who trains.
    """
    with processes.fail_together(), ExitStack() as stack:
        processes.start(options.distributed)
        experiments = list(runs.values())
        in_first_process(lambda: resume.check_new_or_resume(found, experiments, options.resume))
        loggers.check_loggers(options)
        cache = compilation.set_up_jax(options.cache)
        job = prepare(source, experiments[0], found, options, call)
        train_all(job, begin(source, runs, job, cache, stack))


def prepare(
    source: Source, chosen: Experiment, found: Sequence[Folder], options: RunOptions, call: Call
) -> Job:
    """Builds the experiment's objects, and says how they will be trained; arguments as above."""
    with compilation.no_collection():
        setup = objects.build(chosen)
        abstract = programs.abstract_state(*setup[:3])
    begun_with = in_first_process(lambda: _shards_begun_with(found))
    leaves, parts = kept_by_first(lambda: _taken(found, chosen, abstract)) or (None, None)
    shards = _choose_shards(setup.config, abstract, options, begun_with)
    objects.check_memory(setup, abstract, options.vmapped_seeds, shards.devices)
    plan = make_plan(setup.config, chosen.evaluation, options.checkpoints, options.log_every)
    facts = _facts(source, chosen, options, setup, shards) | ({"parts": parts} if parts else {})
    return Job(options, chosen, setup, abstract, shards, plan, facts, call, leaves)


def _taken(found: Sequence[Folder], chosen: Experiment, abstract: PyTree) -> tuple[Any, Any]:
    """Returns what a run that begins takes of other runs, as `read_parts`.

    One that goes on has it in its checkpoints, and reads no other run.
    """
    if found and all(folder.is_begun for folder in found):
        return None, found[0].manifest.get("parts")
    return read_parts(chosen.parts, abstract)


def _shards_begun_with(found: Sequence[Folder]) -> int:
    """Returns how many shards a run was begun with, 0 if there is none yet."""
    begun = [folder for folder in found if folder.is_begun]
    return check_manifest(begun[0])["num_shards"] if begun else 0


def _choose_shards(
    config: Config, abstract: PyTree, options: RunOptions, begun_with: int
) -> Shards:
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
    with users_errors(""):
        check_shards(shards, config.num_envs)
        name = "num_envs / num_shards" if number > 1 else "num_envs"
        check_minibatches(config, is_recurrent(abstract.memory), config.num_envs // number, name)
    return shards


def _facts(
    source: Source, chosen: Experiment, options: RunOptions, setup: objects.Setup, shards: Shards
) -> dict[str, Any]:
    """Returns what manifest.json says of a run that begins now."""
    builders = (chosen.build_env, chosen.build_network)
    kernels = exact.how_chosen(jax.default_backend())
    inexact = getattr(setup.env, "inexact", "")
    facts = manifest.describe_process(setup.engine, builders, kernels, shards.number, inexact)
    facts["model"] = objects.physics_hash(setup.env)
    stepped_by = getattr(getattr(setup.env, "physics", None), "stepped_by", None)
    with objects.naming_broken_rules(setup.env):
        if stepped_by is not None:
            check_env.check_shapes(setup.env)  # a step is traced, and so it is chosen
            facts["stepped_by"] = list(stepped_by)
        facts["arrays"] = hash_held(setup.env, setup.network)
    facts["experiment_file"] = str(source.path)
    if options.vmapped_seeds > 1:
        facts["vmapped_seeds"] = {"first": chosen.seed, "number": options.vmapped_seeds}
    return facts


def begin(source: Source, runs: Runs, job: Job, cache: str, stack: ExitStack) -> list[Seed]:
    """Locks each seed's folder, reads it again, and writes down what the run is.

    Args:
      source: where the experiment came from.
      runs: each seed's folder, and the experiment with its overrides.
      job: what the seeds have in common.
      cache: where compiled programs are kept, for a person.
      stack: gives the locks back at its end.
    """

    @files.writing()
    def locked() -> list[Seed]:
        locks = []
        for path in runs:
            locks.append(FolderLock(path))
            stack.callback(locks[-1].close)
        folders = [run_folder.read(path) for path in runs]  # another process may have been here
        resume.check_new_or_resume(folders, list(runs.values()), job.options.resume)
        begun = any(folder.is_begun for folder in folders)
        written = [
            _write_down(source, folder, one, job, begun)
            for folder, one in zip(folders, runs.values(), strict=True)
        ]
        for line in console.describe_plan(
            job.plan, job.setup, job.abstract, job.facts, list(runs), cache
        ):
            output.say(line)
        each = zip(runs.items(), written, locks, strict=True)
        return [Seed(path, one.seed, folder, lock) for (path, one), folder, lock in each]

    # What folders hold is the first process's to know.
    return kept_by_first(locked) or [Seed(path, one.seed) for path, one in runs.items()]


def _write_down(
    source: Source, folder: Folder, chosen: Experiment, job: Job, begun: bool
) -> Folder:
    """Writes what a run is, unless that is there already; returns what its folder holds then."""
    schedule = {"log_every": job.plan.log_every, "checkpoints": job.options.checkpoints}
    now = resume.Description(resume.describe_config(source, chosen, schedule), job.facts, source)
    facts = resume.what_to_write(folder, now, job.options.allow_changes, begun)
    if facts is None:
        return folder
    checkpoint.check_fits(folder.checkpoints, folder.updates, job.abstract)
    if begun and folder.is_run:
        objects.check_acts(chosen, folder.config["settings"], job.setup.env, job.abstract)
    return run_folder.write(folder, now.config, facts, source.text)
