"""Checkpoints: a whole TrainState on disk, with a hash of every leaf, so that damage is noticed.

Orbax commits a checkpoint by renaming a finished folder, which survives a kill at any moment. But
it checks no array bytes, deletes in place, and mistakes the latest step on a full disk. So hashes
are kept beside the arrays, and `checkpoint_folder.py` looks after the folder.
"""

import contextlib
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.errors import UserError, one_line
from purerl.core.records import PyTree
from purerl.runs import array_files, checkpoint_folder
from purerl.runs.checkpoint_folder import DamagedError, load_meta, path_of
from purerl.runs.state_arrays import Leaves, digest_leaves, leaf_paths, raw, unflatten


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
    meta = meta | {"leaves": {path: _describe(array) for path, array in leaves.items()}}
    path = path_of(folder, meta["update"])
    checkpoint_folder.discard(path)
    stored = {key: array for key, array in leaves.items() if array.size}  # Orbax refuses empty ones
    try:
        array_files.write(path, stored, meta | {"meta_sha256": checkpoint_folder.hash_meta(meta)})
        array_files.flush(path)
    except BaseException:
        checkpoint_folder.discard(path)
        checkpoint_folder.clean(folder)
        raise
    return path


def load(path: Path, abstract: PyTree) -> Saved:
    """Reads one checkpoint and checks every hash.

    Args:
      path: of one update.
      abstract: shapes of the state. A field of it that is None is left out, whatever was saved.

    Raises:
      DamagedError: a file or a leaf is not what was written.
      UserError: it is whole, but of another state than `abstract` (other sizes or networks).
    """
    meta = load_meta(path)
    _check_fits(path, meta, abstract)
    stored = meta["leaves"].items()
    leaves = {key: np.zeros(about["shape"], jnp.dtype(about["dtype"])) for key, about in stored}
    try:
        leaves |= array_files.read(path, {key: x for key, x in leaves.items() if x.size})
    except (PermissionError, MemoryError) as error:  # no damage: it shall not be put aside
        raise UserError(f"The checkpoint {path} cannot be read: {one_line(error)}") from error
    except Exception as error:  # Orbax raises many kinds for broken files, none of them its own
        raise DamagedError(f"its arrays cannot be read ({type(error).__name__})") from error
    for key, about in stored:
        if _describe(leaves[key]) != about:
            raise DamagedError(f"leaf {key} is not what was written (sha256 differs)")
    if digest_leaves(leaves) != meta["digest"]:
        raise DamagedError("the digest of all leaves differs from the one written with them")
    return Saved(unflatten(leaves, abstract), meta)


def newest(
    folders: Sequence[Path], abstract: PyTree, say: Callable[[str], None], rename: bool = True
) -> list[Saved]:
    """Reads the newest update that all folders hold whole.

    Args:
      folders: the checkpoints of a run, or of each of the seeds that train together.
      abstract: shapes of one seed's state.
      say: told of each damaged checkpoint.
      rename: whether to rename damaged ones; False where another process may write the run.

    Returns:
      One checkpoint for each folder; [] if there is no such update.
    """
    for update in reversed(checkpoint_folder.common_updates(folders)):
        found = []
        for folder in folders:
            path = path_of(folder, update)
            try:
                found.append(load(path, abstract))
            except DamagedError as error:
                kept = checkpoint_folder.set_aside(path) if rename else path
                say(f"Checkpoint of update {update} is damaged: {error}. It is kept as {kept}; "
                    "the one before it is taken, if there is one.")  # fmt: skip
        if len(found) == len(folders):
            return found
    return []


def check_fits(folder: Path, abstract: PyTree) -> None:
    """Raises UserError if the newest checkpoint is of another state; reads no array."""
    for update in reversed(checkpoint_folder.updates(folder)):
        path = path_of(folder, update)
        with contextlib.suppress(DamagedError):
            _check_fits(path, load_meta(path), abstract)
            return


def _describe(array: np.ndarray) -> dict[str, Any]:
    content = hashlib.sha256(np.asarray(array).tobytes()).hexdigest()
    return {"dtype": str(array.dtype), "shape": list(array.shape), "sha256": content}


def _check_fits(path: Path, meta: dict[str, Any], abstract: PyTree) -> None:
    shapes = [[str(x.dtype), list(x.shape)] for x in jax.tree.leaves(jax.eval_shape(raw, abstract))]
    wanted = dict(zip(leaf_paths(abstract), shapes, strict=True))
    stored = {
        key: [about["dtype"], about["shape"]]
        for key, about in meta["leaves"].items()
        if getattr(abstract, key.partition("/")[0], key) is not None  # None: left out
    }
    for key in sorted({*wanted, *stored}):
        if wanted.get(key) != stored.get(key):
            raise UserError(
                f"The checkpoint {path} is of another state: leaf {key} is "
                f"{stored.get(key, 'absent')} in it and {wanted.get(key, 'absent')} in this "
                "experiment. Use the settings and the version of purerl that the run began with."
            )
