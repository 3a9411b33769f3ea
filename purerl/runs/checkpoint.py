"""Checkpoints: a whole TrainState on disk, with a hash of every leaf, so that damage is noticed.

Orbax commits a step by renaming a finished folder, which survives a kill at any moment. It checks
no array bytes, deletes in place, and its manager's idea of the latest step goes wrong on a full
disk. So here: hashes beside the arrays, deletion by rename, and the truth read from the folder.

Zero-size arrays, which Orbax refuses, count in the digest but are not written.
"""

import contextlib
import hashlib
import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.errors import UserError, one_line
from purerl.core.records import PyTree, is_key
from purerl.runs import array_files
from purerl.runs.state_arrays import Leaves, digest_leaves, leaf_paths, unflatten


class DamagedError(Exception):
    """A checkpoint that cannot be read whole; the message names the leaf or the file."""


class Saved(NamedTuple):
    """One checkpoint read back, every hash checked."""

    state: PyTree
    meta: dict[str, Any]  # update, steps, digest, and what else `save` was given
    path: Path


def save(folder: Path, leaves: Leaves, meta: dict[str, Any]) -> Path:
    """Writes a checkpoint under `folder` and returns its path; blocks until it is on the disk.

    Args:
      folder: the run's `checkpoints/`.
      leaves: `flatten` of the state.
      meta: JSON values, with at least "update"; hashes are added here.

    Raises:
      OSError or ValueError when the disk refuses; nothing partial is left behind.
    """
    meta = meta | {"leaves": {path: _describe(array) for path, array in leaves.items()}}
    path = folder / f"{meta['update']:012d}"
    discard(path)
    stored = {key: array for key, array in leaves.items() if array.size}
    try:
        array_files.write(path, stored, meta | {"meta_sha256": _meta_hash(meta)})
        array_files.flush(path)
    except BaseException:
        discard(path)
        clean(folder)
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
    leaves = {key: _blank(about) for key, about in meta["leaves"].items()}
    target = {key: array for key, array in leaves.items() if array.size}
    try:
        leaves |= array_files.read(path, target)
    except (PermissionError, MemoryError) as error:  # no damage: it shall not be put aside
        raise UserError(f"The checkpoint {path} cannot be read: {one_line(error)}") from error
    except Exception as error:  # Orbax raises many kinds for broken files, none of them its own
        raise DamagedError(f"its arrays cannot be read ({type(error).__name__})") from error
    for key, about in meta["leaves"].items():
        if _describe(leaves[key]) != about:
            raise DamagedError(
                f"leaf {key} does not have the bytes that were written (sha256 differs)"
            )
    if digest_leaves(leaves) != meta["digest"]:
        raise DamagedError("the digest of all leaves differs from the one written with them")
    return Saved(unflatten(leaves, abstract), meta, path)


def load_meta(path: Path) -> dict[str, Any]:
    """Reads a checkpoint's metadata; DamagedError unless it is what was written."""
    try:
        meta = json.loads((path / "meta" / "metadata").read_text())
        expected = meta.pop("meta_sha256")
    except (OSError, ValueError, KeyError, AttributeError) as error:
        raise DamagedError(f"its metadata cannot be read ({type(error).__name__})") from error
    if _meta_hash(meta) != expected:
        raise DamagedError("its metadata is not what was written (sha256 differs)")
    return meta


def updates(folder: Path) -> list[int]:
    """Returns the updates that have a checkpoint folder, oldest first; whole or not."""
    if not folder.is_dir():
        return []
    return sorted(int(d.name) for d in folder.iterdir() if d.name.isdigit() and d.is_dir())


def check_fits(folder: Path, abstract: PyTree) -> None:
    """Raises UserError if the newest checkpoint is of another state; reads no array."""
    for update in reversed(updates(folder)):
        path = folder / f"{update:012d}"
        with contextlib.suppress(DamagedError):
            _check_fits(path, load_meta(path), abstract)
            return


def check_none_lost(folders: Sequence[Path]) -> None:
    """Raises UserError where there were checkpoints: a run does not silently begin again.

    A kill in the first save leaves none, or of seeds that train together some with one.
    """
    for folder in folders:
        damaged = sorted(path.name for path in folder.glob("damaged-*"))
        if damaged or len(updates(folder)) > 1:
            kept = ", ".join([*damaged, *map(str, updates(folder))])
            shared = " that all seeds have" if len(folders) > 1 else ""
            raise UserError(
                f"{folder} holds no whole checkpoint{shared}, but {kept}: there is nothing to go "
                "on from. Train anew under another --name."
            )


def newest(
    folder: Path, abstract: PyTree, say: Callable[[str], None], set_aside: bool = True
) -> Saved | None:
    """Reads the newest checkpoint that is whole, telling of each one that is not; None without any.

    Args:
      set_aside: rename damaged ones to `damaged-<n>-<update>`; False for readers of a run that
        may be another process's.
    """
    found = newest_of_all([folder], abstract, say, set_aside)
    return found[0] if found else None


def newest_of_all(
    folders: Sequence[Path], abstract: PyTree, say: Callable[[str], None], set_aside: bool = True
) -> list[Saved]:
    """Reads the newest update that all folders hold whole: of seeds that train together."""
    for update in reversed(common_updates(folders)):
        found = []
        for folder in folders:
            path = folder / f"{update:012d}"
            try:
                found.append(load(path, abstract))
            except DamagedError as error:
                kept = _set_aside(path) if set_aside else path
                say(f"Checkpoint of update {update} is damaged: {error}. It is kept as {kept}; "
                    "the one before it is taken, if there is one.")  # fmt: skip
        if len(found) == len(folders):
            return found
    return []


def common_updates(folders: Iterable[Path]) -> list[int]:
    """Returns the updates of which all folders have a checkpoint, oldest first."""
    return sorted(set.intersection(*(set(updates(folder)) for folder in folders)))


def retain(folder: Path, keep: int, together: Sequence[Path] = ()) -> None:
    """Deletes all but the newest `keep` checkpoints and the best one by evaluation.

    With the folders of seeds that train `together`, those count that all of them have.
    """
    best = best_update(folder)
    newest = common_updates([folder, *together])[-keep:]
    for update in updates(folder):
        if newest and update < newest[0] and update != best:
            discard(folder / f"{update:012d}")


def forget_after(folder: Path, last: int) -> None:
    """Deletes the checkpoints after update `last`, which other seeds did not come to save."""
    for update in updates(folder):
        if update > last:
            discard(folder / f"{update:012d}")


def best_update(folder: Path) -> int | None:
    """Returns the update of the checkpoint with the highest evaluation return, None without any."""
    scored = [(meta["eval_return"], meta["update"]) for meta in _metas(folder)]
    scored = [pair for pair in scored if pair[0] is not None]
    return max(scored)[1] if scored else None


def discard(path: Path) -> None:
    """Deletes a checkpoint so that a kill in between leaves none that looks whole."""
    if path.exists():
        doomed = path.with_name(f".deleting-{path.name}")
        shutil.rmtree(doomed, ignore_errors=True)
        path.rename(doomed)
        shutil.rmtree(doomed, ignore_errors=True)


def clean(folder: Path) -> None:
    """Removes what a crash or a full disk left: unfinished saves and unfinished deletions."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if "orbax-checkpoint-tmp" in path.name or path.name.startswith(".deleting-"):
            shutil.rmtree(path, ignore_errors=True)


# --- parts ---


def _blank(about: dict[str, Any]) -> np.ndarray:
    return np.zeros(about["shape"], jnp.dtype(about["dtype"]))


def _describe(array: np.ndarray) -> dict[str, Any]:
    content = hashlib.sha256(np.asarray(array).tobytes()).hexdigest()
    return {"dtype": str(array.dtype), "shape": list(array.shape), "sha256": content}


def _check_fits(path: Path, meta: dict[str, Any], abstract: PyTree) -> None:
    raw = jax.eval_shape(
        lambda s: jax.tree.map(lambda x: jax.random.key_data(x) if is_key(x) else x, s), abstract
    )
    shapes = [[str(x.dtype), list(x.shape)] for x in jax.tree.leaves(raw)]
    wanted = dict(zip(leaf_paths(abstract), shapes, strict=True))
    stored = {key: [about["dtype"], about["shape"]] for key, about in meta["leaves"].items()}
    stored = {key: shape for key, shape in stored.items() if not _is_left_out(key, abstract)}
    for key in sorted({*wanted, *stored}):
        if wanted.get(key) != stored.get(key):
            raise UserError(
                f"The checkpoint {path} is of another state: leaf {key} is "
                f"{stored.get(key, 'absent')} in it and {wanted.get(key, 'absent')} in this "
                "experiment. Use the settings and the version of purerl that the run began with."
            )


def _is_left_out(key: str, abstract: PyTree) -> bool:
    return getattr(abstract, key.partition("/")[0], key) is None


def _metas(folder: Path) -> Iterator[dict[str, Any]]:
    for update in updates(folder):
        try:
            yield load_meta(folder / f"{update:012d}")
        except DamagedError:
            continue


def _meta_hash(meta: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(meta, sort_keys=True).encode()).hexdigest()


def _set_aside(path: Path) -> Path:
    count = 0
    while (kept := path.with_name(f"damaged-{count}-{path.name}")).exists():
        count += 1
    return path.rename(kept)
