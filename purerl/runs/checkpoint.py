"""Checkpoints: a whole TrainState on disk, with a hash of every file and leaf.

A checkpoint is written under another name, flushed to the disk, and then renamed: what bears its
name is whole, after a kill and after a power cut. Orbax writes and reads the arrays, but checks no
byte of them. So hashes are kept beside them, and `checkpoint_folder.py` looks after the folder.
"""

import contextlib
import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from purerl.core.errors import UserError, one_line
from purerl.core.records import PyTree
from purerl.machine import array_files, files
from purerl.machine.state_arrays import Leaves, digest_leaves, leaf_paths, raw, unflatten
from purerl.runs import checkpoint_folder, manifest

WHOLE = "Use the settings and the version of purerl that the run began with."
PART = "A part begins as it is there: give it, and what it reads, those sizes."


class Saved(NamedTuple):
    """One checkpoint read back, every hash checked."""

    state: PyTree
    meta: dict[str, Any]  # update, steps, digest, and what else `save` was given


def save(folder: Path, leaves: Leaves, meta: dict[str, Any]) -> Path:
    """Writes a checkpoint under `folder` and returns its path; blocks until it is on the disk.

    Args:
      folder: the run's `checkpoints/`.
      leaves: `state_arrays.flatten` of the state.
      meta: JSON values, with at least "update"; hashes are added here.

    Raises:
      OSError or ValueError when the disk refuses; nothing partial is left behind.
    """
    path = checkpoint_folder.path_of(folder, meta["update"])
    draft = path.with_name(checkpoint_folder.WRITING + path.name)
    stored = {key: array for key, array in leaves.items() if array.size}  # Orbax refuses empty ones
    try:
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir()
        array_files.write(draft / "state", stored)
        meta = meta | {"leaves": {key: _describe(array) for key, array in leaves.items()}}
        # Where a folder could not be listed for a moment, Orbax left arrays out, and said nothing.
        _compare(array_files.read(draft / "state", stored), meta["leaves"])
        meta["files"] = files.hash_files(draft)
        meta["meta_sha256"] = checkpoint_folder.hash_meta(meta)
        (draft / checkpoint_folder.META).write_text(json.dumps(meta))
        files.sync_tree(draft)
        checkpoint_folder.discard(path)
        draft.rename(path)
        files.sync(folder)
    except BaseException:
        checkpoint_folder.clean(folder)
        raise
    return path


def load_checkpoint(path: Path, abstract: PyTree, owners: Sequence[manifest.Owner] = ()) -> Saved:
    """Reads one checkpoint and checks every hash.

    Args:
      path: of one update.
      abstract: shapes of the state. A field of it that is None is left out, whatever was saved.
      owners: whose checkpoint it may be; none: anybody's.

    Raises:
      DamagedError: a file is not what was written.
      UserError: it cannot be read, or it is whole, but another run's, or of another state than
        `abstract` (other sizes or networks).
    """
    leaves, meta = load_leaves(path, abstract, owners)
    return Saved(unflatten(leaves, abstract), meta)


def load_leaves(path: Path, like: PyTree, owners: Any, ask: Callable = bool) -> tuple[Leaves, Any]:
    """Reads the leaves to whose paths `ask` says yes (`bool`: to all); it raises what that does."""
    meta = checkpoint_folder.load_meta(path)
    manifest.check_owner(path, meta, owners)
    wanted = _check_fits(path, meta, like, ask)
    checkpoint_folder.check_files(path, meta)
    leaves = {key: np.zeros(shape, np.dtype(dtype)) for key, (dtype, shape) in wanted.items()}
    try:
        leaves |= array_files.read(path / "state", {k: x for k, x in leaves.items() if x.size})
        _compare(leaves, meta["leaves"])
        if leaves.keys() == meta["leaves"].keys() and digest_leaves(leaves) != meta["digest"]:
            raise ValueError("the digest of all leaves is another")
    except Exception as error:  # Orbax raises many kinds. Its files are what it wrote, so:
        if not path.exists():
            raise checkpoint_folder.DamagedError("it was deleted meanwhile") from error
        raise UserError(
            f"The checkpoint {path} is whole on the disk, but cannot be read: "
            f"{one_line(error):.300}. Nothing was changed: mend the installation, the memory or "
            "the limits of this process."
        ) from error
    return leaves, meta


def newest(
    folders: Sequence[Path],
    abstract: PyTree,
    say: Callable[[str], None],
    rename: bool = True,
    owners: Sequence[Sequence[manifest.Owner]] = (),
) -> list[Saved]:
    """Reads the newest update that all folders hold whole.

    Args:
      folders: the checkpoints of a run, or of each of the seeds that train together.
      abstract: shapes of one seed's state.
      say: told of each damaged checkpoint.
      rename: whether to rename damaged ones; False where another process may write the run.
      owners: whose checkpoints those of each folder may be.

    Returns:
      One checkpoint for each folder; [] if there is no such update.
    """
    for folder in folders if rename else ():
        checkpoint_folder.take_back(folder, say)
    for update in reversed(checkpoint_folder.common_updates(folders)):
        found = []
        for folder, of in zip(folders, owners or [()] * len(folders), strict=True):
            path = checkpoint_folder.path_of(folder, update)
            try:
                found.append(load_checkpoint(path, abstract, of))
            except checkpoint_folder.DamagedError as error:
                if not path.exists():  # by the run, which goes on and has newer ones
                    return newest(folders, abstract, say, rename, owners)
                kept = checkpoint_folder.set_aside(path) if rename else path
                say(f"Checkpoint of update {update} is damaged: {error}. It is kept as {kept}; "
                    "the one before it is taken, if there is one.")  # fmt: skip
        if len(found) == len(folders):
            return found
    return []


def check_fits(folder: Path, updates: Sequence[int], abstract: PyTree) -> None:
    """Raises UserError if the newest checkpoint is of another state; reads no array.

    Args:
      folder: the checkpoints.
      updates: that have one, oldest first.
      abstract: shapes of the state.
    """
    for update in reversed(updates):
        path = checkpoint_folder.path_of(folder, update)
        with contextlib.suppress(checkpoint_folder.DamagedError):
            _check_fits(path, checkpoint_folder.load_meta(path), abstract, bool)
            return


def _describe(array: np.ndarray) -> dict[str, Any]:
    content = hashlib.sha256(np.asarray(array).tobytes()).hexdigest()
    return {"dtype": str(array.dtype), "shape": list(array.shape), "sha256": content}


def _compare(leaves: Leaves, expected: dict[str, Any]) -> None:
    """Raises ValueError unless arrays that were read are those that were written."""
    for key, array in leaves.items():
        if _describe(array) != expected[key]:
            raise ValueError(f"leaf {key} comes back otherwise (sha256 differs)")


def _check_fits(path: Path, meta: Any, abstract: PyTree, ask: Callable) -> dict[str, tuple]:
    """Returns each leaf's dtype and shape; UserError if those that were saved are others."""
    shapes = [(str(x.dtype), list(x.shape)) for x in jax.tree.leaves(jax.eval_shape(raw, abstract))]
    wanted = {k: x for k, x in zip(leaf_paths(abstract), shapes, strict=True) if ask(k)}
    stored = {
        key: (about["dtype"], about["shape"])
        for key, about in meta["leaves"].items()
        if ask(key) and getattr(abstract, key.partition("/")[0], key) is not None  # or left out
    }
    for key in sorted({*wanted, *stored}):
        if wanted.get(key) != stored.get(key):
            raise UserError(
                f"The checkpoint {path} is of another state: leaf {key} is "
                f"{_shown(stored.get(key))} in it and {_shown(wanted.get(key))} in this "
                f"experiment. {WHOLE if ask is bool else PART}"
            )
    return wanted


def _shown(leaf: tuple | None) -> str:
    return "absent" if leaf is None else str(list(leaf))
