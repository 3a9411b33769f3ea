"""The files of runs: written whole or not at all, and which folders are runs. No JAX.

What a function here has written stays written when the power fails: a file's content by its fsync,
its name by that of its folder.
"""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from purerl.core.errors import UserError, one_line


def read_json(path: Path) -> dict[str, Any]:
    """Reads a JSON file; UserError if it is missing or broken."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {one_line(error)}") from error


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Writes a JSON file; UserError if the disk refuses."""
    write_file(path, (json.dumps(value, indent=2) + "\n").encode())


def write_file(path: Path, content: bytes) -> None:
    """Writes a file whole or not at all; UserError if the disk refuses."""
    draft = draft_of(path)
    try:
        draft.write_bytes(content)
        sync(draft)
        draft.replace(path)
        sync(path.parent)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}.") from error


def make_folder(path: Path) -> None:
    """Makes a folder, and those above it that are missing."""
    missing = [place for place in (path, *path.parents) if not place.exists()]
    for place in reversed(missing):
        place.mkdir(exist_ok=True)
        sync(place.parent)


def sync(path: Path) -> None:
    """Waits until the disk has a file's content, or the names in a folder."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_tree(folder: Path) -> None:
    """Waits until the disk has all that is in a folder, folders in it too; not its own name."""
    for place, _, files in os.walk(folder, topdown=False, onerror=_raise):
        for name in files:
            sync(Path(place, name))
        sync(Path(place))


def _raise(error: OSError) -> None:
    raise error


def hash_files(folder: Path) -> dict[str, str]:
    """Returns each file's sha256, by its path in the folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): hash_file(path) for path in files}


def hash_file(path: Path) -> str:
    """Returns a file's sha256."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def draft_of(path: Path) -> Path:
    """Returns the file that holds what `path` will hold once it is whole."""
    return path.with_name(f".{path.name}.draft")


def runs_in(place: Path) -> list[Path]:
    """Returns the run that a folder is, or the runs one or two levels below it; [] for none."""
    for pattern in ("config.json", "*/config.json", "*/*/config.json"):
        runs = sorted(file.parent for file in place.glob(pattern))
        if runs:
            return runs
    return []
