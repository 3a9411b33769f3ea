"""May this process begin a run in a folder, or go on with the one that is there?

Pure functions of what the folder held (`folder.Folder`) and of what would be written now.
"""

import glob
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import UserError, some
from purerl.experiment import options, settings_json, source_hashes
from purerl.experiment.definition import Experiment
from purerl.experiment.loading import Source
from purerl.machine.files import draft_of
from purerl.ppo.config import Config
from purerl.runs import folder as run_folder, manifest
from purerl.runs.folder import CODE, CONFIG, OURS, Folder, allowed_changes, check_manifest

EDITED = "fingerprint: config.json, manifest.json or experiment.py is not what the run wrote"
# What a line of a change begins with that may change the reward, or how it is discounted.
OF_REWARD = ("settings.env.", "settings.ppo.gamma:", "source.", f"{CODE}:", "model:", "arrays")
MANY = 9  # edited files, which a refusal to resume then counts and does not list


class Description(NamedTuple):
    """The files that describe a run, as a process would write them now."""

    config: dict[str, Any]
    manifest: dict[str, Any]
    source: Source


def check_new_or_resume(
    folders: Sequence[Folder], experiments: Sequence[Experiment], resume: options.Resume
) -> None:
    """Raises UserError if a new run would overwrite something, or there is nothing to resume.

    Args:
      folders: of each seed. Seeds that were killed while starting may have only some of them.
      experiments: of each seed.
      resume: whether the runs are to go on; auto: those that there are.
    """
    if resume is True and not any(folder.exists for folder in folders):
        where = folders[0].path
        if several := sorted(where.parent.glob(f"{glob.escape(where.name)}-seed*")):
            raise UserError(f"There is no run {where}, but {several[0].name}: give --num-seeds.")
        raise UserError(f"There is no run {where} to resume; leave out --resume to start it.")
    for folder, chosen in zip(folders, experiments, strict=True):
        _check_usable(folder, chosen, resume)


def _check_usable(folder: Folder, chosen: Experiment, resume: options.Resume) -> None:
    """Raises UserError if one folder may not be written."""
    run_folder.check_no_links(folder)
    if folder.is_begun and not resume:
        raise UserError(f"The run {folder.path} exists{_how_to_begin(folder, chosen)}")
    # Drafts are of a run that was killed while it started.
    strange = folder.names - OURS - {draft_of(Path(name)).name for name in OURS}
    if strange and not folder.is_run:
        raise UserError(f"{folder.path} is no run (it holds {min(strange)}); use another --name.")
    # config.json is written before all that a run learns.
    if not folder.is_run and (folder.updates or folder.damaged):
        raise UserError(
            f"{folder.path} holds checkpoints, but its {CONFIG} is gone, which says what they "
            "are of. Bring it back from a copy, or use another --name."
        )


def _how_to_begin(folder: Folder, chosen: Experiment) -> str:
    """Returns what to do where a run has the folder already; one of other settings cannot go on."""
    there = folder.config.get("settings", {})
    unlike = manifest.differences(there, settings_json.to_json(chosen))
    if not unlike:
        return "; use --resume to go on, or another --name."
    if len(unlike) == 1 and unlike[0].startswith("ppo.num_steps"):
        return f" ({unlike[0]}); to train longer, copy it first (docs/howto/go_on.md)."
    return f", with other settings ({some(unlike, 1)}); use another --name."


def describe_config(source: Source, chosen: Experiment, schedule: dict[str, Any]) -> dict[str, Any]:
    """Returns config.json: every setting of the run; UserError if one cannot be read back."""
    values = settings_json.to_json(chosen)
    rebuilt = settings_json.from_json(source.experiment, values)
    for name, value in settings_json.settings_of(chosen).items():
        if (read := getattr(rebuilt, name)) != value:
            raise UserError(
                f"{CONFIG} cannot hold {name}: {value} would be read back as {read}. Give what "
                "the experiment's file may leave empty (None, or ()) a value of its own kind there."
            )
    return {"experiment": source.name, "settings": values, "schedule": schedule}


def what_to_write(
    folder: Folder, now: Description, allow_changes: bool, begun: bool
) -> dict[str, Any] | None:
    """Returns the manifest.json to write before training; None: the run goes on as it is.

    Args:
      folder: the run, or where it will be.
      now: what this process would write of a new run.
      allow_changes: whether to go on, and note it, where the old run would not go on exactly.
      begun: whether it, or a seed that trains together with it, has a checkpoint. What has none is
        written anew, since a mistake in the command may have ended it.

    Raises:
      UserError: this process would not continue the run exactly; or it has nothing to train.
    """
    found = changes(folder, now) if folder.is_run else []
    if folder.is_run and not found:
        return None
    if not (folder.is_run and begun):
        return _identity(folder) | now.manifest
    if not allow_changes:
        raise UserError(
            f"The run {folder.path} was begun under other conditions, so it would not go on "
            "exactly:\n  " + "\n  ".join(_shortened(found)) + f"\n{cure(found)}, train anew under "
            "another --name, or go on all the same with --allow-changes."
        )
    _check_trains_what_is_new(folder, now.config, found)
    return now.manifest | _noted(folder, found)


def changes(folder: Folder, now: Description) -> list[str]:
    """Returns in what this process would not continue the run exactly, a line each."""
    found = manifest.differences(folder.config, now.config)
    found += manifest.differences(check_manifest(folder), now.manifest)
    if source_hashes.hash_code(folder.code) != source_hashes.hash_code(now.source.text):
        found.append(f"{CODE}: {now.source.path} has been edited")
    return found + [EDITED] * folder.is_edited


def _check_trains_what_is_new(folder: Folder, config: dict[str, Any], found: list[str]) -> None:
    """Raises UserError where a run that is done would be given settings that it never had.

    And where an update would have other steps: budget, schedule and evaluations count updates.
    """
    old, now = folder.config["settings"]["ppo"], Config(**config["settings"]["ppo"])
    if (before := old["num_envs"] * old["rollout_length"]) != now.steps_per_update:
        raise UserError(
            f"The run {folder.path} counts updates of num_envs * rollout_length = {before} steps, "
            f"and cannot go on with {now.steps_per_update}: keep both, or use another --name."
        )
    changed = [line for line in found if line.startswith("settings.")]
    if changed and max(folder.updates, default=0) >= now.num_updates:
        raise UserError(
            f"The run {folder.path} has all of its updates, so none would be trained with what is "
            "new:\n  " + "\n  ".join(changed) + "\nRaise --ppo.num-steps, or use another --name."
        )


def cure(found: list[str]) -> str:
    """Returns what takes a run back to what it was, by what was found."""
    if EDITED in found:
        return "Put the file back that was edited"
    if any(line.startswith("vmapped_seeds") for line in found):
        return "Give the --num-seeds and --seed it was begun with"
    if any("purerl_experiment_" in line and "(absent)" in line for line in found):
        return "Give the command in the folder it was begun in"
    if all(line.startswith("arrays") for line in found):
        return "Put back the data, of a file or another run, that the environment or network holds"
    if all(line.startswith(("source.", f"{CODE}: ", "arrays")) for line in found):
        return "Put back what was edited"
    if all(line.startswith("model: ") for line in found):  # no setting and no code has made it so
        return "Put back what was edited of the MuJoCo model, the MJCF or a file that it reads"
    of_command = any(line.startswith(("settings.", "schedule.")) for line in found)
    if of_command and any(line.startswith(("source.", f"{CODE}: ")) for line in found):
        return "Put back what was edited, or give every setting it was begun with"
    given = "Leave out what differs" if of_command else "Give the command it was begun with"
    if any(line.startswith("settings.ppo.num_steps") for line in found):
        return f"{given}; to train longer, copy the run first (docs/howto/go_on.md)"
    return given


def _shortened(found: list[str]) -> list[str]:
    """Returns differences for a person: many edited files as a number, and what to do for NPROC."""
    pin = "device.threads"  # a CPU's bits depend on the size of XLA's thread pool
    threads = [line.split()[1] for line in found if line.startswith(pin)]
    found = manifest.count_files(found, MANY, ", as of another version of purerl")
    return found + [f"(NPROC={number} brings {pin} back)" for number in threads]


def begins_stage(folder: Folder, update: int) -> bool:
    """Tells whether a run goes on after `update` with what may be another reward."""
    noted = (x["changes"] for x in allowed_changes(folder) if x["after_update"] == update)
    return any(line.startswith(OF_REWARD) for lines in noted for line in lines)


def _identity(folder: Folder) -> dict[str, str]:
    """Returns what tells a new run from all others: a random id, and the folder's name."""
    return {"run_id": uuid.uuid4().hex[:12], "name": folder.path.name}


def _noted(folder: Folder, found: list[str]) -> dict[str, Any]:
    """Returns what manifest.json says of a run that goes on under other conditions.

    A copy under another name gets a run_id of its own: loggers must not take it for the first run.
    """
    old = folder.manifest
    known = {name: old[name] for name in ("run_id", "name")}
    noted = with_change(old, max(folder.updates, default=0), found)
    if known["name"] != folder.path.name:
        noted["allowed_changes"][-1]["of"], known = known, _identity(folder)
    had = {name: old[name] for name in ("had_checkpoint",) if name in old}
    return known | had | noted


def with_change(facts: dict[str, Any], after: int, found: list[str]) -> dict[str, Any]:
    """Returns the list of what --allow-changes let pass, as manifest.json has it, with one more."""
    entry = {"after_update": after, "changes": found, "fingerprint": facts["fingerprint"]}
    return {"allowed_changes": [*facts.get("allowed_changes", []), entry]}
