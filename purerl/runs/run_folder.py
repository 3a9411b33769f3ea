"""A run's folder: who may write to it, what it says about the run, and how to rebuild it."""

import contextlib
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax

from purerl.core.errors import RunError, UserError, one_line
from purerl.core.records import PyTree, TrainState
from purerl.devices.programs import abstract_state
from purerl.runs import checkpoint, checkpoint_folder, experiment, identity, manifest
from purerl.runs.build_experiment import Setup, build, own_line, physics_hash
from purerl.runs.experiment import Experiment, Source
from purerl.runs.files import (
    check_is_run,
    check_memory,
    check_no_links,
    draft_of,
    make_folder,
    read_bytes,
    read_json,
    write_file,
    write_json,
)
from purerl.runs.lock import LOCK
from purerl.runs.loggers import Say
from purerl.runs.source_hashes import module_file, source_hashes
from purerl.runs.trust import load_copy

OURS = {LOCK, "config.json", "manifest.json", "experiment.py", "metrics.jsonl", "checkpoints"}
MANY = 9  # edited files, which a refusal to resume then counts and does not list


class RestoredRun(NamedTuple):
    """A run read back from its folder alone."""

    experiment: Experiment
    setup: Setup
    saved: checkpoint.Saved


# --- beginning, and going on ---


@contextlib.contextmanager
def refusals() -> Iterator[None]:
    """Turns a disk's refusal of what a run needs at its beginning into a UserError."""
    try:
        yield
    except OSError as error:
        where = error.filename or "The folder of the run"
        raise UserError(f"{where} cannot be read or written: {error.strerror or error}.") from error


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
        check_no_links(folder)
        is_run = (folder / "config.json").exists()
        if is_run and not resume:
            raise UserError(f"The run {folder} exists; use --resume to go on, or another --name.")
        strange = {path.name for path in folder.iterdir()} - OURS if folder.is_dir() else set()
        strange -= {draft_of(folder / name).name for name in OURS}  # of a run killed while starting
        if strange and not is_run:
            raise UserError(f"{folder} is no run (it holds {min(strange)}); use another --name.")
        # config.json is written before all that a run learns.
        if not is_run and checkpoint_folder.holds_any(folder / "checkpoints"):
            raise UserError(
                f"{folder} holds checkpoints, but its config.json is gone, which says what they "
                "are of. Bring it back from a copy, or use another --name."
            )


def describe(source: Source, chosen: Experiment, schedule: dict[str, Any]) -> dict[str, Any]:
    """Returns config.json: every setting of the run; UserError if one cannot be read back."""
    settings = experiment.to_json(chosen)
    rebuilt = experiment.from_json(source.experiment, settings)
    for name, value in experiment.settings(chosen).items():
        if (read := getattr(rebuilt, name)) != value:
            raise UserError(
                f"config.json cannot hold {name}: {value} would be read back as {read}. Give what "
                "the experiment's file may leave empty (None, or ()) a value of its own kind there."
            )
    return {"experiment": source.name, "settings": settings, "schedule": schedule}


def begin_or_go_on(
    folder: Path,
    source: Source,
    settings: dict[str, Any],
    facts: dict[str, Any],
    abstract: PyTree,
    allow_changes: bool,
) -> None:
    """Writes down what a new run is, or checks that this process would continue the old one.

    Args:
      folder: the run.
      source: the experiment as it is now.
      settings: what config.json would say now.
      facts: what manifest.json would say now.
      abstract: shapes of the state.
      allow_changes: whether to go on, and note it, where the old run would not go on exactly.
    """
    if not (folder / "config.json").exists():
        _write(folder, source, settings, _identity(folder) | facts)
        return
    old = manifest.read(folder)
    found = manifest.differences(read_json(folder / "config.json"), settings)
    found += manifest.differences(old, facts)
    if read_bytes(folder / "experiment.py") != source.text:
        found.append(f"experiment.py: {source.path} has been edited")
    found += edited(folder)
    if found and not allow_changes:
        raise UserError(
            f"The run {folder} was begun under other conditions, so it would not go on exactly:\n  "
            + "\n  ".join(_shortened(found))
            + "\nGive the command it was begun with, train anew under another --name, or go on all "
            "the same with --allow-changes."
        )
    if found:
        checkpoint.check_fits(folder / "checkpoints", abstract)
        _write(folder, source, settings, facts | _noted(folder, old, found))


def _write(folder: Path, source: Source, settings: dict[str, Any], facts: dict[str, Any]) -> None:
    """Writes the three files that describe a run; config.json last, it makes it a run."""
    code = source.text
    facts = facts | {"fingerprint": identity.fingerprint(settings, facts, code)}
    make_folder(folder / "checkpoints")
    write_file(folder / "experiment.py", code)
    write_json(folder / "manifest.json", facts)
    write_json(folder / "config.json", settings)


def edited(folder: Path) -> list[str]:
    """Returns a line if the three files that describe a run are not what it wrote."""
    facts, config = read_json(folder / "manifest.json"), read_json(folder / "config.json")
    code = read_bytes(folder / "experiment.py")
    if facts.get("fingerprint") == identity.fingerprint(config, facts, code):
        return []
    return ["fingerprint: config.json, manifest.json or experiment.py is not what the run wrote"]


def _identity(folder: Path) -> dict[str, str]:
    """Returns what tells a new run from all others: a random id, and the folder's name."""
    return {"run_id": uuid.uuid4().hex[:12], "name": folder.name}


def _shortened(found: list[str]) -> list[str]:
    """Returns differences for a person: many edited files as a number, and what to do for NPROC."""
    pin = "device.threads"  # a CPU's bits depend on the size of XLA's thread pool
    threads = [line.split()[1] for line in found if line.startswith(pin)]
    edited = [line for line in found if line.startswith("source.")]
    if len(edited) > MANY:
        found = [line for line in found if line not in edited]
        found.append(f"source: {len(edited)} files, as of another version of purerl")
    return found + [f"(NPROC={number} brings {pin} back)" for number in threads]


def _noted(folder: Path, old: dict[str, Any], found: list[str]) -> dict[str, Any]:
    """Returns what manifest.json says of a run that goes on under other conditions.

    A copy under another name gets a run_id of its own: loggers must not take it for the first run.
    """
    known = {name: old[name] for name in ("run_id", "name")}
    after = max(checkpoint_folder.updates(folder / "checkpoints"), default=0)
    entry: dict[str, Any] = {"after_update": after, "changes": found}
    entry["fingerprint"] = old["fingerprint"]
    if known["name"] != folder.name:
        entry, known = {"of": known} | entry, _identity(folder)
    had = {name: old[name] for name in ("had_checkpoint",) if name in old}
    return known | had | {"allowed_changes": [*old.get("allowed_changes", []), entry]}


def signature(folder: Path) -> dict[str, Any]:
    """Returns what the run's checkpoints say of whose they are."""
    facts, config = read_json(folder / "manifest.json"), read_json(folder / "config.json")
    return identity.signature(facts, config)


def note_change(folder: Path, update: int, change: str) -> None:
    """Notes in manifest.json something that --allow-changes let pass after `update`."""
    facts = read_json(folder / "manifest.json")
    entry = {"after_update": update, "changes": [change], "fingerprint": facts["fingerprint"]}
    changes = [*facts.get("allowed_changes", []), entry]
    write_json(folder / "manifest.json", facts | {"allowed_changes": changes})


def note_checkpoint(folder: Path) -> None:
    """Notes in manifest.json that the run has a checkpoint: it never again begins anew."""
    facts = read_json(folder / "manifest.json")
    if not facts.get("had_checkpoint"):
        write_json(folder / "manifest.json", facts | {"had_checkpoint": True})


# --- reading back ---


def restore(
    folder: Path | str, update: str, say: Say, engine: str = "", trust: bool = False
) -> RestoredRun:
    """Rebuilds a run from its folder alone, to see what its policy does; changes nothing in it.

    The state comes without `env`, `episode` and `optimizer`: a policy needs none of them, and on
    another engine or with another version of this package they may be laid out otherwise.

    Args:
      folder: the run.
      update: "latest", "best" (highest evaluation return), or an update's number.
      say: told of damaged checkpoints, and of what is no longer as it was when the run began.
      engine: instead of the run's own, where that one is not at hand.
      trust: whether its code may be executed though it is not known; see `trust.load_copy`.
    """
    folder = Path(folder)
    check_is_run(folder)
    config = read_json(folder / "config.json", experiment=str, settings=dict)
    begun = manifest.read(folder)
    source = load_copy(folder, config["experiment"], Path(begun["experiment_file"]), trust)
    settings = _fill(config["settings"], experiment.to_json(source.experiment), say)
    chosen = experiment.from_json(
        source.experiment, settings | ({"engine": engine} if engine else {})
    )
    try:
        setup = build(chosen)
    except (UserError, RunError):
        raise
    except Exception as error:  # of code that trained: it, or its settings, is another since
        what = f"{one_line(error)}{own_line(error)}"
        raise UserError(f"{folder} cannot be built with its config.json: {what}") from error
    for what in _changed_since(begun, source, setup):
        say(f"{what} is not that of the run any more.")
    for what in edited(folder):
        say(f"Edited since the run: {what}.")
    abstract = abstract_state(*setup[:3])
    abstract = abstract.replace(env=None, episode=None, optimizer=None)
    check_memory(folder, sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(abstract)))
    return RestoredRun(chosen, setup, _choose(folder / "checkpoints", update, abstract, say, begun))


def _changed_since(begun: dict[str, Any], source: Source, setup: Setup) -> list[str]:
    """Lists what has changed since the run began and may change what its policy does."""
    builders = (source.experiment.build_env, source.experiment.build_network)
    now, then = source_hashes(builders), begun["source"]
    edited = [name for name, value in now.items() if then.get(name) != value]
    # The run's own copy of its experiment, `source`, cannot have been edited.
    edited = [name for name in edited if module_file(name) != source.path]
    few = ", ".join(edited[:3]) + (f" and {len(edited) - 3} more" if len(edited) > 3 else "")
    found = [f"The code of {few}"] if edited else []
    if setup.engine == begun["engine"] and physics_hash(setup.env) != begun["model"]:
        found.append("MuJoCo's model")
    return found


def _fill(old: Any, new: Any, say: Say, path: str = "") -> Any:
    """Returns the settings `old` of a run, and from `new` those that the code got since then."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return old
    for name in new.keys() - old.keys():
        say(f"config.json lacks {path}{name}; it is taken as {new[name]}.")
    return new | {name: _fill(old[name], new.get(name), say, f"{path}{name}.") for name in old}


def _choose(
    folder: Path, update: str, abstract: TrainState, say: Say, facts: dict[str, Any]
) -> checkpoint.Saved:
    """Reads the checkpoint that was asked for; see `restore`."""
    owners = identity.owners(facts)
    if update == "latest":
        whole = checkpoint.newest([folder], abstract, say, rename=False, owners=[owners])
        if not whole:
            raise UserError(f"{folder.parent} has no whole checkpoint yet.")
        return whole[0]
    number = checkpoint_folder.best_update(folder) if update == "best" else update
    if number is None:
        raise UserError(f"No checkpoint in {folder} was taken at an evaluation; try latest.")
    found = list(map(str, checkpoint_folder.updates(folder)))
    if str(number) not in found:
        valid = ", ".join(["latest", "best", *found])
        raise UserError(f"There is no checkpoint {update!r} in {folder}. Valid: {valid}.")
    try:
        return checkpoint.load(checkpoint_folder.path_of(folder, int(number)), abstract, owners)
    except checkpoint_folder.DamagedError as error:
        raise UserError(f"The checkpoint of update {number} is damaged: {error}.") from error
