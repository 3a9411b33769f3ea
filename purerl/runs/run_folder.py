"""A run's folder: who may write to it, what it says about the run, and how to rebuild it."""

import contextlib
import fcntl
import os
import shutil
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

from purerl.core.errors import UserError
from purerl.core.records import TrainState
from purerl.devices.programs import abstract_state
from purerl.runs import checkpoint, checkpoint_folder, experiment, manifest
from purerl.runs.build_experiment import Setup, build, physics_hash
from purerl.runs.experiment import Experiment, Source
from purerl.runs.files import draft_of, read_json, runs_in, write_json
from purerl.runs.loggers import Say
from purerl.runs.source_hashes import module_file, source_hashes

LOCK = ".lock"
OURS = {LOCK, "config.json", "manifest.json", "experiment.py", "metrics.jsonl", "checkpoints"}


class RestoredRun(NamedTuple):
    """A run read back from its folder alone."""

    experiment: Experiment
    setup: Setup
    saved: checkpoint.Saved
    settings: dict[str, Any]  # config.json


def lock(folder: Path) -> IO[str]:
    """Makes the folder and locks it for this process, until the process ends in whatever way."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = (folder / LOCK).open("a+")
    except OSError as error:
        raise UserError(f"The folder {folder} cannot be written: {error.strerror}.") from error
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        handle.seek(0)
        owner = handle.read().strip() or "unknown"
        raise UserError(
            f"The run {folder} is being written by process {owner}; stop that one first, or use "
            "another --name."
        ) from error
    handle.truncate(0)
    handle.write(str(os.getpid()))
    handle.flush()
    return handle


@contextlib.contextmanager
def refusals() -> Iterator[None]:
    """Turns a disk's refusal to write what a run needs at its beginning into a UserError."""
    try:
        yield
    except OSError as error:
        where = error.filename or "The folder of the run"
        raise UserError(f"{where} cannot be written: {error.strerror or error}.") from error


def check_new_or_resume(folders: Iterable[Path], resume: bool) -> None:
    """Raises UserError if a new run would overwrite something, or there is nothing to resume.

    Args:
      folders: one for each seed. Seeds that were killed while starting may have only some of them.
      resume: whether the runs are to go on.
    """
    folders = list(folders)
    if resume and not any(folder.exists() for folder in folders):
        raise UserError(f"There is no run {folders[0]} to resume; leave out --resume to start it.")
    for folder in folders:
        is_run = (folder / "config.json").exists()
        if is_run and not resume:
            raise UserError(f"The run {folder} exists; use --resume to go on, or another --name.")
        strange = {path.name for path in folder.iterdir()} - OURS if folder.is_dir() else set()
        strange -= {draft_of(folder / name).name for name in OURS}  # of a run killed while starting
        if strange and not is_run:
            raise UserError(f"{folder} is no run (it holds {min(strange)}); use another --name.")


def describe(source: Source, chosen: Experiment, schedule: dict[str, Any]) -> dict[str, Any]:
    """Returns config.json: every setting of the run; UserError if one cannot be read back."""
    settings = experiment.to_json(experiment.settings(chosen))
    rebuilt = experiment.from_json(source.experiment, settings)
    for name, value in experiment.settings(chosen).items():
        if (read := getattr(rebuilt, name)) != value:
            raise UserError(
                f"config.json cannot hold {name}: {value} would be read back as {read}. Give what "
                "the experiment's file may leave empty (None, or ()) a value of its own kind there."
            )
    return {"experiment": source.name, "settings": settings, "schedule": schedule}


def start(folder: Path, source: Source, settings: dict[str, Any], facts: dict[str, Any]) -> None:
    """Writes the three files that describe a new run; config.json last, it makes it a run."""
    shutil.copyfile(source.path, folder / "experiment.py")
    write_json(folder / "manifest.json", identity(folder) | facts)
    write_json(folder / "config.json", settings)


def identity(folder: Path) -> dict[str, str]:
    """Returns what tells a new run from all others: a random id, and the folder's name."""
    return {"run_id": uuid.uuid4().hex[:12], "name": folder.name}


def check_same(
    folder: Path, source: Source, settings: dict[str, Any], facts: dict[str, Any]
) -> list[str]:
    """Lists how this process differs from the one that began the run.

    Args:
      folder: the run.
      source: the experiment as it is now.
      settings: what config.json would say now.
      facts: what manifest.json would say now.

    Returns:
      A line for each difference; none: the run goes on exactly.
    """
    found = manifest.differences(read_json(folder / "config.json"), settings)
    found += manifest.differences(read_json(folder / "manifest.json"), facts)
    if (folder / "experiment.py").read_bytes() != source.path.read_bytes():
        found.append(f"experiment.py: {source.path} has been edited")
    return found


def accept_changes(
    folder: Path, source: Source, settings: dict[str, Any], facts: dict[str, Any], found: list[str]
) -> None:
    """Writes down after which update the run goes on under other conditions, and which.

    A copy under another name gets a run_id of its own: loggers must not take it for the first run.
    """
    old = read_json(folder / "manifest.json")
    known = {"run_id": old.get("run_id", ""), "name": old.get("name", folder.name)}
    after = max(checkpoint_folder.updates(folder / "checkpoints"), default=0)
    entry: dict[str, Any] = {"after_update": after, "changes": found}
    if known["name"] != folder.name:
        entry, known = {"of": known} | entry, identity(folder)
    kept = known | {"allowed_changes": [*old.get("allowed_changes", []), entry]}
    shutil.copyfile(source.path, folder / "experiment.py")
    write_json(folder / "manifest.json", facts | kept)
    write_json(folder / "config.json", settings)


def amend(folder: Path, facts: dict[str, Any]) -> None:
    """Adds to manifest.json what is known only when the programs are compiled."""
    path = folder / "manifest.json"
    write_json(path, read_json(path) | facts)


def restore(folder: Path | str, update: str, say: Say, engine: str = "") -> RestoredRun:
    """Rebuilds a run from its folder alone, to see what its policy does; changes nothing in it.

    The state comes without `env`, `episode` and `optimizer`: a policy needs none of them, and on
    another engine or with another version of this package they may be laid out otherwise.

    Args:
      folder: the run.
      update: "latest", "best" (highest evaluation return), or an update's number.
      say: told of damaged checkpoints, and of what is no longer as it was when the run began.
      engine: instead of the run's own, where that one is not at hand.
    """
    folder = Path(folder)
    check_is_run(folder)
    settings = read_json(folder / "config.json")
    begun = read_json(folder / "manifest.json")
    original = Path(begun["experiment_file"]) if "experiment_file" in begun else None
    source = experiment.load(folder / "experiment.py", settings["experiment"], original)
    filled = fill(settings["settings"], experiment.to_json(source.experiment), say)
    chosen = experiment.from_json(source.experiment, filled)
    if engine:
        chosen = experiment.from_json(chosen, experiment.to_json(chosen) | {"engine": engine})
    setup = build(chosen)
    for what in changed_since(begun, source, setup):
        say(f"{what} is not that of the run any more.")
    abstract = abstract_state(*setup[:3])
    abstract = abstract.replace(env=None, episode=None, optimizer=None)
    saved = _choose(folder / "checkpoints", update, abstract, say)
    return RestoredRun(chosen, setup, saved, settings)


def check_is_run(folder: Path) -> None:
    """Raises UserError unless a folder holds a run; the message lists the runs inside of it."""
    if not (folder / "config.json").is_file():
        inside = ", ".join(map(str, runs_in(folder)))
        runs = f" Runs in it: {inside}." if inside else ""
        what = "no run: it has no config.json" if folder.is_dir() else "no folder"
        raise UserError(f"{folder} is {what}.{runs}")


def changed_since(begun: dict[str, Any], source: Source, setup: Setup) -> list[str]:
    """Lists what has changed since the run began and may change what its policy does.

    Args:
      begun: the run's manifest.json.
      source: the run's own copy of its experiment, which cannot have been edited.
      setup: what it builds now.
    """
    builders = (source.experiment.build_env, source.experiment.build_network)
    then, now = begun.get("source"), source_hashes(builders)
    then = then if isinstance(then, dict) else {}
    edited = [name for name, value in now.items() if then.get(name) != value]
    edited = [name for name in edited if module_file(name) != source.path]
    few = ", ".join(edited[:3]) + (f" and {len(edited) - 3} more" if len(edited) > 3 else "")
    found = [f"The code of {few}"] if edited else []
    model = physics_hash(setup.env)
    if setup.engine == begun.get("engine") and model != begun.get("model", model):
        found.append("MuJoCo's model")
    return found


def fill(old: Any, new: Any, say: Say, path: str = "") -> Any:
    """Returns the settings `old` of a run, and from `new` those that the code got since then."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return old
    for name in new.keys() - old.keys():
        say(f"config.json lacks {path}{name}; it is taken as {new[name]}.")
    return new | {name: fill(old[name], new.get(name), say, f"{path}{name}.") for name in old}


def _choose(folder: Path, update: str, abstract: TrainState, say: Say) -> checkpoint.Saved:
    found = checkpoint_folder.updates(folder)
    if update == "latest":
        whole = checkpoint.newest([folder], abstract, say, rename=False)
        if not whole:
            raise UserError(f"{folder.parent} has no whole checkpoint yet.")
        return whole[0]
    number = checkpoint_folder.best_update(folder) if update == "best" else update
    if number is None:
        raise UserError(f"No checkpoint in {folder} was taken at an evaluation; try latest.")
    if str(number) not in map(str, found):
        valid = ", ".join(["latest", "best", *map(str, found)])
        raise UserError(f"There is no checkpoint {update!r} in {folder}. Valid: {valid}.")
    try:
        return checkpoint.load(checkpoint_folder.path_of(folder, int(number)), abstract)
    except checkpoint_folder.DamagedError as error:
        raise UserError(f"The checkpoint of update {number} is damaged: {error}.") from error
