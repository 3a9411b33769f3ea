"""A run rebuilt from its folder alone, to see what its policy does."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import jax

from purerl.checks import held_arrays, user_code
from purerl.core.errors import RunError, UserError, one_line, some
from purerl.devices import memory, programs
from purerl.experiment import definition, loading, settings_json, source_hashes
from purerl.experiment.objects import Setup, build, physics_hash
from purerl.experiment.trust import load_copy
from purerl.machine.output import Say
from purerl.runs import checkpoint, checkpoint_folder, manifest
from purerl.runs.folder import CODE, CONFIG, Folder, check_manifest, read_run
from purerl.runs.resume import EDITED


class RestoredRun(NamedTuple):
    """A run read back from its folder alone."""

    experiment: definition.Experiment
    setup: Setup
    saved: checkpoint.Saved
    source: loading.Source  # the experiment as its file has it
    folder: Folder


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
      engine: instead of the run's own. Without one, a run of warp is played on c where there is no
        GPU: on a CPU warp compiles for minutes.
      trust: whether its code may be executed though it is not known; see `trust.load_copy`.
    """
    run = read_run(Path(folder))
    begun = check_manifest(run)
    original = Path(begun["experiment_file"]).absolute()
    source = load_copy(run.path / CODE, run.code, run.config["experiment"], original, trust)
    settings = fill(run.config["settings"], settings_json.to_json(source.experiment), say)
    if not engine and settings["engine"] == "warp" and jax.default_backend() == "cpu":
        engine = "c"  # which needs no extra, and begins at once
        say(f"{folder} was trained on engine warp; it is played on c, for there is no GPU.")
    settings |= {"engine": engine} if engine else {}
    chosen = settings_json.from_json(source.experiment, settings)
    try:
        setup = build(chosen)
    except (UserError, RunError):
        raise
    except Exception as error:  # of code that trained: it, or its settings, is another since
        what = f"{one_line(error)}{user_code.own_line(error)}"
        raise UserError(f"{folder} cannot be built with its {CONFIG}: {what}") from error
    for what in _changed_since(begun, source, setup):
        say(f"{folder}: {what} is not that of the run any more.")
    if run.is_edited:
        say(f"Edited since the run: {EDITED}.")
    return RestoredRun(chosen, setup, read_checkpoint(run, update, setup, say), source, run)


def read_checkpoint(run: Folder, update: str, setup: Setup, say: Say) -> checkpoint.Saved:
    """Reads a checkpoint of a run whose objects are built; arguments as for `restore`.

    Raises UserError if this machine has no room to read a state of its size.
    """
    abstract = programs.abstract_state(*setup[:3])
    abstract = abstract.replace(env_state=None, episode=None, optimizer=None)
    size, room = memory.size(abstract), memory.of_machine()
    if 2 * size > room:  # a reader holds it twice
        raise UserError(
            f"The state of {run.path} takes {size / 1e9:,.0f} GB, by its config.json; this machine "
            f"has {room / 1e9:,.0f} GB of memory."
        )
    folder, owners = run.checkpoints, manifest.owners(check_manifest(run))
    if update == "latest":
        whole = checkpoint.newest([folder], abstract, say, rename=False, owners=[owners])
        if not whole:
            raise UserError(f"{run.path} has no whole checkpoint yet.")
        return whole[0]
    path = find_checkpoint(run, update)
    try:
        return checkpoint.load_checkpoint(path, abstract, owners)
    except checkpoint_folder.DamagedError as error:
        raise UserError(f"The checkpoint {path} is damaged: {error}.") from error


def _changed_since(begun: dict[str, Any], source: loading.Source, setup: Setup) -> list[str]:
    """Lists what has changed since the run began and may change what its policy does."""
    builders = (source.experiment.build_env, source.experiment.build_network)
    now, then = source_hashes.source_hashes(builders), begun["source"]
    edited = [name for name, value in now.items() if then.get(name) != value]
    # The run's own copy of its experiment, `source`, cannot have been edited.
    edited = [name for name in edited if source_hashes.module_file(name) != source.path]
    found = [f"The code of {some(edited, 3)}"] if edited else []
    if setup.engine == begun["engine"] and physics_hash(setup.env) != begun["model"]:
        found.append("MuJoCo's model")
    held = begun.get("arrays")  # of older runs there is none
    if not edited and held and held != held_arrays.hash_held(setup.env, setup.network):
        found.append("The data that the environment or the network holds")
    return found


def fill(old: Any, new: Any, say: Say, path: str = "") -> Any:
    """Returns the settings `old` of a run, and from `new` those that the code got since then."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return old
    for name in new.keys() - old.keys():
        say(f"{CONFIG} lacks {path}{name}; it is taken as {new[name]}.")
    return new | {name: fill(old[name], new.get(name), say, f"{path}{name}.") for name in old}


def find_checkpoint(run: Folder, update: str) -> Path:
    """Returns the path of the checkpoint that is asked for, as `restore`; reads no array."""
    folder = run.checkpoints
    found = list(map(str, checkpoint_folder.updates(folder)))
    number: int | str = (found or [update])[-1] if update == "latest" else update
    if update == "best":
        *_, (score, number) = [(-math.inf, 0), *checkpoint_folder.best_by_stage(folder).values()]
        if score == -math.inf:
            since = " since its last change" * bool(run.manifest.get("allowed_changes"))
            raise UserError(f"No checkpoint in {folder} was evaluated{since}; try latest.")
    if str(number) not in found:
        valid = ", ".join(["latest", "best", *found])
        raise UserError(f"There is no checkpoint {update!r} in {folder}. Valid: {valid}.")
    return checkpoint_folder.path_of(folder, int(number))
