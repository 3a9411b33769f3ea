"""The folder `checkpoints/` of a run: which updates it holds, their metadata, what may go. No JAX.

A checkpoint is a folder named after its update. Its metadata hold a hash of themselves, so that
damage is noticed. `checkpoint.py` reads and writes the arrays.
"""

import contextlib
import hashlib
import json
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from purerl.core.errors import UserError


class DamagedError(Exception):
    """A checkpoint that cannot be read whole; the message names the leaf or the file."""


def path_of(folder: Path, update: int) -> Path:
    """Returns where the checkpoint of an update stands in `folder`."""
    return folder / f"{update:012d}"


def load_meta(path: Path) -> dict[str, Any]:
    """Reads a checkpoint's metadata; DamagedError unless it is what was written."""
    try:
        meta = json.loads((path / "meta" / "metadata").read_text())
        expected = meta.pop("meta_sha256")
    except (OSError, ValueError, KeyError, AttributeError) as error:
        raise DamagedError(f"its metadata cannot be read ({type(error).__name__})") from error
    if hash_meta(meta) != expected:
        raise DamagedError("its metadata is not what was written (sha256 differs)")
    return meta


def hash_meta(meta: dict[str, Any]) -> str:
    """Returns the sha256 of a checkpoint's metadata."""
    return hashlib.sha256(json.dumps(meta, sort_keys=True).encode()).hexdigest()


def updates(folder: Path) -> list[int]:
    """Returns the updates that have a checkpoint, oldest first; it may be damaged."""
    if not folder.is_dir():
        return []
    return sorted(int(d.name) for d in folder.iterdir() if d.name.isdigit() and d.is_dir())


def common_updates(folders: Iterable[Path]) -> list[int]:
    """Returns the updates of which all folders have a checkpoint, oldest first."""
    return sorted(set.intersection(*(set(updates(folder)) for folder in folders)))


def best_update(folder: Path) -> int | None:
    """Returns the update of the checkpoint with the highest evaluation return, None without any."""
    scored = []
    for update in updates(folder):
        with contextlib.suppress(DamagedError):
            score = load_meta(path_of(folder, update))["eval_return"]
            scored += [(score, update)] if score is not None else []
    return max(scored)[1] if scored else None


def check_none_lost(folders: Sequence[Path]) -> None:
    """Raises UserError where there were checkpoints: a run does not silently begin again.

    A kill during the first save leaves no checkpoint, or one for some of the seeds that train
    together.
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


def retain(folder: Path, keep: int, together: Sequence[Path] = ()) -> None:
    """Deletes old checkpoints, but never the best one by evaluation.

    Args:
      folder: a run's checkpoints.
      keep: how many of the newest ones stay.
      together: the folders of all seeds that train together. Then only checkpoints that all of
        them have are counted.
    """
    newest = common_updates([folder, *together])[-keep:]
    for update in {*updates(folder)} - {best_update(folder)}:
        if newest and update < newest[0]:
            discard(path_of(folder, update))


def forget_after(folder: Path, last: int) -> None:
    """Deletes the checkpoints after update `last`, which other seeds did not come to save."""
    for update in updates(folder):
        if update > last:
            discard(path_of(folder, update))


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


def set_aside(path: Path) -> Path:
    """Renames a damaged checkpoint to `damaged-<n>-<update>`; returns its new place."""
    count = 0
    while (kept := path.with_name(f"damaged-{count}-{path.name}")).exists():
        count += 1
    return path.rename(kept)
