"""Files: read with care, written whole or not at all. No JAX.

What a function here has written stays written when the power fails: a file's content by its fsync,
its name by that of its folder.

A folder may come from a stranger. What stands where a file should be shall neither hang its reader
(a pipe, a device) nor fill the memory, and what it says is checked where it is read.
"""

import contextlib
import csv
import errno
import hashlib
import io
import json
import os
import re
import reprlib
import stat
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import NoneType
from typing import Any, get_args

from purerl.core.errors import UserError, one_line, reason
from purerl.machine.output import printable

LARGEST = 16 << 20  # [bytes] of a JSON file
LONGEST_NAME = 200  # [bytes]; most file systems take 255, and a seed's number may follow
DEEPEST = 50  # objects and lists in each other; Python's own recursion ends at some hundreds
FORMULA = re.compile(r"[=+@-](?![\d.]+(e[+-]?\d+)?$|inf$)")
KINDS = {
    dict: "an object {name: value}", list: "a list", str: "a string", int: "a whole number",
    float: "a number", bool: "true or false", NoneType: "null",
}  # fmt: skip


# --- reading ---


@contextlib.contextmanager
def open_file(path: Path) -> Iterator[io.BufferedReader]:
    """Opens a file to be read; OSError for a pipe, a device, a folder."""
    try:
        # Without O_NONBLOCK a pipe would wait for a writer.
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except ValueError as error:  # a name with a null byte
        raise OSError(errno.EINVAL, str(error), str(path)) from error
    try:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "it is no regular file", str(path))
        with open(handle, "rb", closefd=False) as file:
            yield file
    finally:
        os.close(handle)


def read_small(path: Path, largest: int = LARGEST) -> bytes:
    """Reads a file; OSError unless it is a regular one of at most `largest` bytes."""
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > largest:
            raise OSError(errno.EFBIG, f"it has {size:,} bytes, of at most {largest:,}", str(path))
        return file.read(size)


def read_bytes(path: Path, largest: int = LARGEST) -> bytes:
    """Reads a file as `read_small`; UserError if it cannot."""
    try:
        return read_small(path, largest)
    except (OSError, MemoryError) as error:
        raise UserError(f"{path} cannot be read: {reason(error)}.") from error


def read_json(path: Path, **kinds: Any) -> dict[str, Any]:
    """Reads a JSON file that holds an object.

    Args:
      path: the file.
      kinds: the keys that are needed, and the type of each value: `settings=dict`,
        `model=str | None`.

    Raises:
      UserError: the file is missing or broken, or lacks a key, or its value is of another type.
    """
    return check_object(str(path), parse(str(path), read_bytes(path)), **kinds)


def check_object(where: str, value: Any, /, **kinds: Any) -> dict[str, Any]:
    """Returns `value` if it is a JSON object with these keys; `where` is for the message."""
    if not isinstance(value, dict):
        raise UserError(f"{where} holds {reprlib.repr(value)}; it must hold {KINDS[dict]}.")
    for name, kind in kinds.items():
        valid = get_args(kind) or (kind,)
        if name not in value:
            raise UserError(f"{where} lacks {name}, which a run's has.")
        if type(value[name]) not in valid:  # a bool is no int
            must = " or ".join(KINDS[one] for one in valid)
            raise UserError(f"{where}: {name} is {reprlib.repr(value[name])}; it must be {must}.")
    return value


def parse(where: str, text: bytes) -> Any:
    """Returns JSON as a value; UserError if it is none, or nested too deeply to be a run's."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError, MemoryError) as error:
        raise UserError(f"{where} is no JSON: {one_line(error)}.") from error
    level = [value]
    for _ in range(DEEPEST):
        nested = [x for x in level if isinstance(x, dict | list)]
        level = [x for one in nested for x in (one.values() if isinstance(one, dict) else one)]
        if not level:
            return value
    raise UserError(f"{where} is nested more than {DEEPEST} deep, which no file of a run is.")


# --- writing ---


@contextlib.contextmanager
def writing(path: Path | None = None) -> Iterator[None]:
    """Turns a disk's refusal of what is written to `path`, None: for a run, into a UserError."""
    try:
        yield
    except OSError as error:
        where = path or error.filename or "The folder of the run"
        what = "written" if path else "read or written"
        raise UserError(f"{where} cannot be {what}: {error.strerror or error}.") from error


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Writes a JSON file; UserError if the disk refuses."""
    write_file(path, (json.dumps(value, indent=2) + "\n").encode())


def write_file(path: Path, content: bytes) -> None:
    """Writes a file whole or not at all; UserError if the disk refuses."""
    draft = draft_of(path)
    with writing(path):
        draft.unlink(missing_ok=True)  # it may be a link
        with draft.open("xb") as file:
            file.write(content)
        sync(draft)
        draft.replace(path)
        sync(path.parent)


def open_log(path: Path, mode: str = "ab") -> Any:
    """Opens a file to which lines are added; OSError for a link, or a pipe that nobody reads."""
    flags = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY
    return open(path, mode, 0, opener=lambda name, how: os.open(name, how | flags, 0o666))


def as_csv(columns: Sequence[str], rows: Iterable[dict[str, Any]]) -> bytes:
    """Returns a table as CSV; what is None or missing is an empty cell.

    No text commands a terminal, and none is a formula where a spreadsheet opens it.
    """

    def cell(value: Any) -> Any:
        said = printable(value) if isinstance(value, str) else value
        return f"'{said}" if FORMULA.match(str(said)) else said

    file = io.StringIO(newline="")
    writer = csv.DictWriter(file, columns, extrasaction="ignore", lineterminator="\n")
    for row in (dict(zip(columns, columns, strict=True)), *rows):
        writer.writerow({name: cell(value) for name, value in row.items()})
    return file.getvalue().encode()


def write_answer(path: Path, content: bytes) -> None:
    """Writes a file that a person has named: whole or not at all, as `write_file`.

    A device, a pipe or a link, such as /dev/stdout, is written into: a file in its place would be
    the end of it.
    """
    if path.is_symlink() or (path.exists() and not path.is_file()):
        with writing(path):
            path.write_bytes(content)
    else:
        write_file(path, content)


def write_arrays(path: Path, arrays: dict[str, Any]) -> None:
    """Writes arrays by name as npz, as `write_answer`; by a path numpy would add to its name."""
    import numpy as np

    content = io.BytesIO()
    np.savez(content, **arrays)
    write_answer(path, content.getvalue())


def check_writable(path: Path) -> None:
    """Raises UserError if a file that a person has named could not be written, before the work."""
    place = path.absolute().parent
    if not os.access(place, os.W_OK) or path.is_dir():
        raise UserError(f"{path} cannot be written: is {place} a folder of yours?")


def check_new(path: Path) -> None:
    """Raises UserError if a file that a person has named is there, or could not be written."""
    if path.is_file():
        raise UserError(f"{path} is there: name another file, or take that one away.")
    check_writable(path)


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
    with open_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def draft_of(path: Path) -> Path:
    """Returns the file that holds what `path` will hold once it is whole."""
    return path.with_name(f".{path.name}.draft")


# --- names, and what may stand in a folder ---


def check_name(what: str, name: str) -> None:
    """Raises UserError unless a name is that of one folder, which can be printed and typed."""
    fits = name.isprintable() and len(os.fsencode(name)) <= LONGEST_NAME
    if not fits or "/" in name or name in ("", ".", "..") or name.startswith("-"):
        raise UserError(
            f"{what} is {reprlib.repr(name)}; it must be the name of one folder: at most "
            f"{LONGEST_NAME} bytes, all printable, without / and not '', '.', '..' or -..."
        )


def check_inside(folder: Path, path: Path) -> None:
    """Raises UserError where a link in a run's folder leads `path` out of it.

    The folder itself may be a link, and anything above it.
    """
    if not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder)):
        raise UserError(f"{path} is a link that leaves the run's folder: put a copy there instead.")


def check_plain(folder: Path) -> None:
    """Raises UserError if a folder holds, at any depth, what is neither a file nor a folder.

    Who opens a pipe waits for ever. A file may be a link to one elsewhere; a folder may not.
    """
    for place, folders, files in os.walk(folder):
        for path in (Path(place, name) for name in (*folders, *files)):
            with contextlib.suppress(FileNotFoundError):  # the run may be going on
                plain = stat.S_ISREG(path.stat().st_mode) or path.is_dir() and not path.is_symlink()
                if not plain:
                    raise UserError(f"{path} is neither a file nor a folder.")
