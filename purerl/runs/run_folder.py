"""A run's folder: what it says about the run, and whether this process may begin it or go on."""

import contextlib
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from purerl.core.errors import UserError
from purerl.core.records import PyTree
from purerl.ppo.config import Config
from purerl.runs import checkpoint, checkpoint_folder, experiment, identity, manifest
from purerl.runs.experiment import Experiment, Source
from purerl.runs.files import (
    check_no_links,
    draft_of,
    make_folder,
    read_bytes,
    read_json,
    write_file,
    write_json,
)
from purerl.runs.lock import LOCK

OURS = {LOCK, "config.json", "manifest.json", "experiment.py", "metrics.jsonl", "checkpoints"}
EDITED = "fingerprint: config.json, manifest.json or experiment.py is not what the run wrote"
MANY = 9  # edited files, which a refusal to resume then counts and does not list


@contextlib.contextmanager
def refusals() -> Iterator[None]:
    """Turns a disk's refusal of what a run needs at its beginning into a UserError."""
    try:
        yield
    except OSError as error:
        where = error.filename or "The folder of the run"
        raise UserError(f"{where} cannot be read or written: {error.strerror or error}.") from error


def check_new_or_resume(runs: Mapping[Path, Experiment], resume: bool) -> None:
    """Raises UserError if a new run would overwrite something, or there is nothing to resume.

    Args:
      runs: each seed's folder, and its experiment. Seeds that were killed while starting may have
        only some of the folders.
      resume: whether the runs are to go on.
    """
    folders = list(runs)
    if resume and not any(folder.exists() for folder in folders):
        raise UserError(f"There is no run {folders[0]} to resume; leave out --resume to start it.")
    for folder in folders:
        check_no_links(folder)
        is_run = (folder / "config.json").exists()
        if is_run and not resume and is_begun(folder):
            raise UserError(f"The run {folder} exists{_how_to_begin(folder, runs[folder])}")
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


def _how_to_begin(folder: Path, chosen: Experiment) -> str:
    """Returns what to do where a run has the folder already; one of other settings cannot go on."""
    there = read_json(folder / "config.json").get("settings", {})
    unlike = manifest.differences(there, experiment.to_json(chosen))
    if not unlike:
        return "; use --resume to go on, or another --name."
    if len(unlike) == 1 and unlike[0].startswith("ppo.num_steps"):
        return f" ({unlike[0]}); to train longer, copy it first (docs/howto/go_on.md)."
    more = f", and {len(unlike) - 1} more" if len(unlike) > 1 else ""
    return f", with other settings ({unlike[0]}{more}); use another --name."


def is_begun(folder: Path) -> bool:
    """Tells whether a run has, or had, a checkpoint; one without has nothing to protect."""
    if not (folder / "config.json").exists():
        return False
    return checkpoint_folder.holds_any(folder / "checkpoints") or _had_checkpoint(folder)


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
    begun: bool,
) -> None:
    """Writes down what a new run is, or checks that this process would continue the old one.

    Args:
      folder: the run.
      source: the experiment as it is now.
      settings: what config.json would say now.
      facts: what manifest.json would say now.
      abstract: shapes of the state.
      allow_changes: whether to go on, and note it, where the old run would not go on exactly.
      begun: whether it, or a seed that trains together with it, has a checkpoint. What has none is
        written anew, since a mistake in the command may have ended it.
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
    if found and not begun:
        _write(folder, source, settings, _identity(folder) | facts)
        return
    if found and not allow_changes:
        raise UserError(
            f"The run {folder} was begun under other conditions, so it would not go on exactly:\n  "
            + "\n  ".join(_shortened(found))
            + f"\n{cure(found)}, train anew under another --name, or go on all the same with "
            "--allow-changes."
        )
    if found:
        _check_trains_what_is_new(folder, settings, found)
        checkpoint.check_fits(folder / "checkpoints", abstract)
        _write(folder, source, settings, facts | _noted(folder, old, found))


def _check_trains_what_is_new(folder: Path, settings: dict[str, Any], found: list[str]) -> None:
    """Raises UserError where a run that is done would be given settings that it never had."""
    changed = [line for line in found if line.startswith("settings.")]
    planned = Config(**settings["settings"]["ppo"]).num_updates
    if changed and max(checkpoint_folder.updates(folder / "checkpoints"), default=0) >= planned:
        raise UserError(
            f"The run {folder} has all of its updates, so none would be trained with what is new:"
            "\n  " + "\n  ".join(changed) + "\nRaise --ppo.num-steps, or use another --name."
        )


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
    return [EDITED]


def cure(found: list[str]) -> str:
    """Returns what takes a run back to what it was, by what was found."""
    if EDITED in found:
        return "Put the file back that was edited"
    if any(line.startswith("vmapped_seeds") for line in found):
        return "Give the --num-seeds and --seed it was begun with"
    if any("purerl_experiment_" in line and "(absent)" in line for line in found):
        return "Give the command in the folder it was begun in"
    if all(line.startswith(("source.", "experiment.py: ")) for line in found):
        return "Put back what was edited"
    if all(line.startswith("model: ") for line in found):  # no setting and no code has made it so
        return "Put back what was edited of the MuJoCo model, the MJCF or a file that it reads"
    given = "Give the command it was begun with" + _options(found)
    if any(line.startswith("settings.ppo.num_steps") for line in found):
        return f"{given}; to train longer, copy the run first (docs/howto/go_on.md)"
    return given


def _options(found: list[str]) -> str:
    """Returns the options that bring settings back that differ, as a clause; "" if there is none.

    >>> _options(["settings.ppo.num_steps: 300000 -> 500000", "versions.jax: 1 -> 2"])
    ', which has --ppo.num-steps 300000'
    """
    lines = [line.removeprefix("settings.") for line in found if line.startswith("settings.")]
    parts = [line.partition(" -> ")[0].split(": ", 1) for line in lines]
    words = [
        f"--{name.replace('_', '-')} {value.strip('[]').replace(',', '')}" for name, value in parts
    ]
    return f", which has {' '.join(words)}" if words else ""


def _identity(folder: Path) -> dict[str, str]:
    """Returns what tells a new run from all others: a random id, and the folder's name."""
    return {"run_id": uuid.uuid4().hex[:12], "name": folder.name}


def _shortened(found: list[str]) -> list[str]:
    """Returns differences for a person: many edited files as a number, and what to do for NPROC."""
    pin = "device.threads"  # a CPU's bits depend on the size of XLA's thread pool
    threads = [line.split()[1] for line in found if line.startswith(pin)]
    found = manifest.count_files(found, MANY, ", as of another version of purerl")
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
    if not _had_checkpoint(folder):
        facts = read_json(folder / "manifest.json")
        write_json(folder / "manifest.json", facts | {"had_checkpoint": True})


def _had_checkpoint(folder: Path) -> bool:
    return bool(read_json(folder / "manifest.json").get("had_checkpoint"))
