"""A run rebuilt from its folder alone, to see what its policy does."""

from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import RunError, UserError, one_line
from purerl.core.records import TrainState
from purerl.devices import memory
from purerl.devices.programs import abstract_state
from purerl.runs import checkpoint, checkpoint_folder, experiment, identity, manifest
from purerl.runs.build_experiment import Setup, build, physics_hash
from purerl.runs.experiment import Experiment, Source
from purerl.runs.files import check_is_run, read_json, without_removed
from purerl.runs.loggers import Say
from purerl.runs.run_folder import edited
from purerl.runs.source_hashes import module_file, source_hashes
from purerl.runs.trust import load_copy
from purerl.runs.user_code import own_line


class RestoredRun(NamedTuple):
    """A run read back from its folder alone."""

    experiment: Experiment
    setup: Setup
    saved: checkpoint.Saved
    source: Source  # the experiment as its file has it


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
    known = {k: without_removed(v) if k == "ppo" else v for k, v in config["settings"].items()}
    settings = _fill(known, experiment.to_json(source.experiment), say)
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
    return RestoredRun(chosen, setup, read_checkpoint(folder, update, setup, say), source)


def read_checkpoint(folder: Path, update: str, setup: Setup, say: Say) -> checkpoint.Saved:
    """Reads a checkpoint of a run whose objects are built; arguments as for `restore`."""
    abstract = abstract_state(*setup[:3])
    abstract = abstract.replace(env=None, episode=None, optimizer=None)
    _check_memory(folder, memory.size(abstract))
    return _choose(folder / "checkpoints", update, abstract, say, manifest.read(folder))


def _check_memory(folder: Path, size: int) -> None:
    """Raises UserError if this machine has no room to read a state of `size` bytes."""
    if 2 * size > (room := memory.of_machine()):  # a reader holds it twice
        raise UserError(
            f"The state of {folder} takes {size / 1e9:,.0f} GB, by its config.json; this machine "
            f"has {room / 1e9:,.0f} GB of memory."
        )


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
