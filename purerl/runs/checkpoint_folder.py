"""The folder `checkpoints/` of a run: which updates it holds, their metadata, what may go. No JAX.

A checkpoint is a folder named after its update: `state/`, which Orbax writes, and `meta.json`, with
the sha256 of each file, of each leaf and of itself, and whose checkpoint it is. What cannot be read
may be whole, so nothing is called damaged but what was read and has another hash.
"""

import contextlib
import hashlib
import json
import math
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from purerl.core.errors import UserError, one_line
from purerl.machine.files import check_object, check_plain, hash_file, read_small, sync

META = "meta.json"
WRITING, DELETING = ".writing-", ".deleting-"


class DamagedError(Exception):
    """A checkpoint that is not what was written; the message names the file."""


def path_of(folder: Path, update: int) -> Path:
    """Returns where the checkpoint of an update stands in `folder`."""
    return folder / f"{update:012d}"


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Tells what cannot be read from what is damaged: a UserError, and all stays as it is."""
    try:
        yield
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DamagedError(f"{Path(str(error.filename)).name} is missing") from error
    except OSError as error:
        raise UserError(
            f"The checkpoint {path} cannot be read: {one_line(error)}. It may be whole, and is "
            "kept as it is: mend that, and give the same command again."
        ) from error


def load_meta(path: Path) -> dict[str, Any]:
    """Reads a checkpoint's metadata.

    Raises:
      DamagedError: it is not what was written.
      UserError: it cannot be read, or was written by another program or version.
    """
    with reading(path):
        text = read_small(path / META)
    try:
        meta = json.loads(text)
        expected = meta.pop("meta_sha256")
        found = hash_meta(meta)
    except (ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
        raise DamagedError(f"{META} is cut or overwritten ({type(error).__name__})") from error
    if found != expected:
        raise DamagedError(f"{META} is not what was written (sha256 differs)")
    check_object(
        str(path / META), meta, update=int, steps=int, wall_s=float, digest=str, metrics_bytes=int,
        metrics_sha256=str, leaves=dict, files=dict,
    )  # fmt: skip
    for leaf in meta["leaves"].values():
        check_object(f"{path / META}: leaves", leaf, dtype=str, shape=list, sha256=str)
    return meta


def hash_meta(meta: dict[str, Any]) -> str:
    """Returns the sha256 of a checkpoint's metadata."""
    return hashlib.sha256(json.dumps(meta, sort_keys=True).encode()).hexdigest()


def check_files(path: Path, meta: dict[str, Any]) -> None:
    """Compares every file of a checkpoint with its hash in the metadata.

    Raises:
      DamagedError: a file is not what was written.
      UserError: a file cannot be read, or the checkpoint is of another update than its name says.
    """
    with reading(path):
        check_plain(path)
    if path_of(path.parent, meta["update"]) != path and path.name.isdigit():
        raise UserError(
            f"The checkpoint {path} is of update {meta['update']}: it has been renamed. Name it "
            f"{path_of(path.parent, meta['update']).name}, or move it out of the folder."
        )
    for name, expected in meta["files"].items():
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise UserError(f"{path / META} names a file outside of the checkpoint: {name!r}.")
        with reading(path):
            found = hash_file(path / name)
        if found != expected:
            raise DamagedError(f"{name} is not what was written (sha256 differs)")


def updates(folder: Path) -> list[int]:
    """Returns the updates that have a checkpoint, oldest first; it may be damaged."""
    if not folder.is_dir():
        return []
    names = [path.name for path in folder.iterdir() if path.is_dir()]
    return sorted(int(name) for name in names if re.fullmatch(r"[0-9]{12}", name))


def listed(folder: Path) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Returns the updates that have a checkpoint, and the names of those that were set aside."""
    damaged = (path.name for path in folder.glob("damaged-*"))
    return tuple(updates(folder)), tuple(sorted(damaged))


def common_updates(folders: Iterable[Path]) -> list[int]:
    """Returns the updates of which all folders have a checkpoint, oldest first."""
    return sorted(set.intersection(*(set(updates(folder)) for folder in folders)))


def best_by_stage(folder: Path) -> dict[str | None, tuple[float, int]]:
    """Returns the highest evaluation return of each stage and its update; the last stage is last.

    A stage begins where --allow-changes let something pass: the return may be another measure then.
    It is named by the fingerprint. Where none of its checkpoints was evaluated, the return is -inf.
    """
    found: dict[str | None, tuple[float, int]] = {}
    for update in updates(folder):
        with contextlib.suppress(DamagedError):
            meta = load_meta(path_of(folder, update))
            run, score = meta.get("run"), meta.get("eval_return")
            stage = str(run.get("fingerprint")) if isinstance(run, dict) else None
            one = (score if isinstance(score, float) else -math.inf, update)
            found[stage] = max(found.pop(stage, one), one)
    return found


def check_none_lost(folders: Sequence[Path], promised: bool) -> None:
    """Raises UserError where there were checkpoints: a run does not silently begin again.

    Args:
      folders: the checkpoints of each of the seeds that train together. A kill during the first
        save leaves none, or one for some of the seeds.
      promised: whether manifest.json says that all of them had one.
    """
    for folder in folders:
        found, damaged = listed(folder)
        if damaged or promised or len(found) > 1:
            kept = ", ".join([*damaged, *map(str, found)])
            shared = " that all seeds have" if len(folders) > 1 else ""
            raise UserError(
                f"{folder} holds no whole checkpoint{shared}, but {kept or 'it had'}: there is "
                "nothing to go on from. Bring one back from a copy, or train anew under another "
                "--name."
            )


def retain(folder: Path, keep: int, together: Sequence[Path] = ()) -> None:
    """Deletes old checkpoints, but never the best one of a stage by evaluation.

    Args:
      folder: a run's checkpoints.
      keep: how many of the newest ones stay.
      together: the folders of all seeds that train together. Then only checkpoints that all of
        them have are counted.
    """
    newest = common_updates([folder, *together])[-keep:]
    best = {update for score, update in best_by_stage(folder).values() if score > -math.inf}
    for update in {*updates(folder)} - best:
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
        doomed = path.with_name(DELETING + path.name)
        shutil.rmtree(doomed, ignore_errors=True)
        path.rename(doomed)
        sync(path.parent)
        shutil.rmtree(doomed, ignore_errors=True)


def clean(folder: Path) -> None:
    """Removes what a crash or a full disk left: unfinished saves and unfinished deletions."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.name.startswith((WRITING, DELETING)):
            shutil.rmtree(path, ignore_errors=True)


def set_aside(path: Path) -> Path:
    """Renames a damaged checkpoint to `damaged-<n>-<update>`; returns its new place."""
    count = 0
    while (kept := path.with_name(f"damaged-{count}-{path.name}")).exists():
        count += 1
    path.rename(kept)
    sync(path.parent)
    return kept


def take_back(folder: Path, say: Callable[[str], None]) -> None:
    """Looks again at what was set aside, and takes back what is whole: reading may have failed."""
    for kept in sorted(folder.glob("damaged-*")):
        parts = re.fullmatch(r"damaged-[0-9]+-([0-9]{12})", kept.name)
        path = folder / parts[1] if parts else kept
        if path.exists():
            continue
        with contextlib.suppress(DamagedError, UserError):
            meta = load_meta(kept)
            check_files(kept, meta)
            if path_of(folder, meta["update"]) == path:
                kept.rename(path)
                sync(folder)
                say(f"{kept} is whole after all: it is the checkpoint {path} again.")
