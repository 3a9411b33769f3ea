"""A file system after a power cut: which trees the changes that a process made may have left.

`Disk.apply` takes the changes of a record in turn. `Disk.tree(model)` is what a cut at this moment
may leave. A file system promises no more than POSIX does: bytes are on the disk after fsync of
their file, names after fsync of their folder. What is not promised may be there, or not.

    strict    only what was promised; ext4 mounted with other options, XFS, btrfs, NFS servers
    names     all names, but only promised bytes: ext4's famous files of length zero
    torn      all names, and half of the bytes that were not promised
    zeros     all names, and zeros instead of the bytes that were not promised
    written   everything, as after a plain kill of the process
"""

from __future__ import annotations

import os
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

MODELS = ("strict", "names", "torn", "zeros", "written")
Tree = dict[str, bytes | None]  # path below the root -> a file's bytes, None: a folder


class Change(NamedTuple):
    """A change that a process made, or a promise that it asked for."""

    kind: str  # create, write, truncate, fsync, syncfs, rename, link, mkdir, remove
    inode: int
    number: int  # where bytes were written, or a file's new length
    path: str
    other: str  # the new name
    data: bytes

    def __str__(self) -> str:
        """Returns it in words."""
        size = f" {len(self.data)} bytes at {self.number}" if self.kind == "write" else ""
        return f"{self.kind} {self.path}{f' -> {self.other}' if self.other else ''}{size}"


def read_record(path: Path) -> list[Change]:
    """Reads what `shim.c` has written; RuntimeError if it met a call that has no model here."""
    text, at, changes = path.read_bytes(), 0, []
    while at < len(text):
        end = text.index(b"\n", at)
        kind, *numbers = text[at:end].decode().split(" ")
        inode, number, *lengths = map(int, numbers)
        parts, at = [], end + 1
        for length in lengths:
            parts.append(text[at : at + length])
            at += length
        changes.append(Change(kind, inode, number, parts[0].decode(), parts[1].decode(), parts[2]))
        if kind == "unknown":
            raise RuntimeError(f"there is no model of this call: {changes[-1]}")
    return changes


@dataclass(eq=False)
class _File:
    data: bytes = b""
    promised: bytes = b""


@dataclass(eq=False)
class _Folder:
    entries: dict[str, _File | _Folder] = field(default_factory=dict)
    promised: dict[str, _File | _Folder] = field(default_factory=dict)


class _Entry(NamedTuple):
    """A name that is to stand for a node, or (None) for nothing."""

    folder: _Folder
    name: str
    node: _File | _Folder | None


class Disk:
    """The files below a root; those that were there when recording began are all on the disk."""

    def __init__(self, root: Path | str, begun: bool = False) -> None:
        """Begins with an empty folder, whose path is `root`, or if `begun` with what is in it."""
        self.root = str(root)
        self.top = _Folder()
        self.nodes: dict[int, _File | _Folder] = {}
        self.pending: list[tuple[_Entry, ...]] = []  # changes of names that nobody promised yet
        for path in sorted(Path(root).rglob("*")) if begun else ():
            data = b"" if path.is_dir() else path.read_bytes()
            node = _Folder() if path.is_dir() else _File(data, data)
            self.nodes[path.stat().st_ino] = node
            _set((self._entry(str(path), node),), promised=False)
            _set((self._entry(str(path), node),), promised=True)

    def apply(self, change: Change) -> None:
        """Takes the next change."""
        getattr(self, f"_{change.kind}")(change)

    def tree(self, model: str) -> Tree:
        """Returns what a cut at this moment may leave, by one of `MODELS`."""
        found: Tree = {}

        def walk(folder: _Folder, place: str) -> None:
            entries = folder.promised if model == "strict" else folder.entries
            for name, node in entries.items():
                if isinstance(node, _Folder):
                    found[place + name] = None
                    walk(node, f"{place}{name}/")
                else:
                    found[place + name] = _bytes_left(node, model)

        walk(self.top, "")
        return found

    # --- changes of bytes ---

    def _write(self, change: Change) -> None:
        file = self._file(change)
        before = file.data[: change.number].ljust(change.number, b"\0")
        file.data = before + change.data + file.data[change.number + len(change.data) :]

    def _truncate(self, change: Change) -> None:
        file = self._file(change)
        file.data = file.data[: change.number].ljust(change.number, b"\0")

    def _fsync(self, change: Change) -> None:
        # An inode without a name is the root itself.
        node = self.nodes.get(change.inode, self.top)
        if isinstance(node, _Folder):
            self._promise_names(node)
        else:
            node.promised = node.data

    def _syncfs(self, change: Change) -> None:
        for node in [self.top, *self.nodes.values()]:
            if isinstance(node, _Folder):
                self._promise_names(node)
            else:
                node.promised = node.data

    # --- changes of names ---

    def _create(self, change: Change) -> None:
        self.nodes[change.inode] = _File()
        self._change_names(self._entry(change.path, self.nodes[change.inode]))

    def _mkdir(self, change: Change) -> None:
        self.nodes[change.inode] = _Folder()
        self._change_names(self._entry(change.path, self.nodes[change.inode]))

    def _link(self, change: Change) -> None:
        self._change_names(self._entry(change.other, self._at(change.path)))

    def _remove(self, change: Change) -> None:
        self._change_names(self._entry(change.path, None))

    def _rename(self, change: Change) -> None:
        node = self._at(change.path)
        if node is self._find(change.other):  # POSIX: two names of one file stay
            return
        self._change_names(self._entry(change.path, None), self._entry(change.other, node))

    def _change_names(self, *entries: _Entry) -> None:
        """Changes names at once, and remembers that nobody has promised them."""
        _set(entries, promised=False)
        self.pending.append(entries)

    def _promise_names(self, folder: _Folder) -> None:
        """Puts a folder's names on the disk.

        A rename between two folders comes whole, and with it what the other one had become before.
        """
        touched, coming, staying = {id(folder)}, [], []
        for entries in reversed(self.pending):
            if touched & {id(entry.folder) for entry in entries}:
                touched |= {id(entry.folder) for entry in entries}
                coming.append(entries)
            else:
                staying.append(entries)
        self.pending = staying[::-1]
        for entries in reversed(coming):
            _set(entries, promised=True)

    # --- finding ---

    def _file(self, change: Change) -> _File:
        node = self.nodes[change.inode]
        assert isinstance(node, _File), change
        return node

    def _entry(self, path: str, node: _File | _Folder | None) -> _Entry:
        parent, _, name = path.rpartition("/")
        folder = self._at(parent)
        assert isinstance(folder, _Folder), path
        return _Entry(folder, name, node)

    def _at(self, path: str) -> _File | _Folder:
        node = self._find(path)
        assert node is not None, f"{path} was made before recording began"
        return node

    def _find(self, path: str) -> _File | _Folder | None:
        node: _File | _Folder | None = self.top
        for name in path.removeprefix(self.root).strip("/").split("/"):
            if name:
                node = node.entries.get(name) if isinstance(node, _Folder) else None
        return node


def _set(entries: tuple[_Entry, ...], promised: bool) -> None:
    for folder, name, node in entries:
        names = folder.promised if promised else folder.entries
        names.pop(name, None)
        if node is not None:
            names[name] = node


def _bytes_left(file: _File, model: str) -> bytes:
    """Returns what a cut leaves of a file's bytes."""
    data, promised = file.data, file.promised
    if model == "written" or data == promised:
        return data
    # What both begin with is in the file, whichever of them is: it grew, or was cut and grew again.
    kept = os.path.commonprefix([promised, data])
    if model == "torn":
        return data[: (len(kept) + len(data)) // 2]
    if model == "zeros":
        return kept.ljust(len(data), b"\0")
    return promised


def trees(
    disk: Disk, changes: list[Change], cuts: Container[int], models: Sequence[str] = MODELS
) -> Iterator[tuple[int, str, Tree]]:
    """Yields the trees that a power cut may leave.

    Args:
      disk: as it was before the changes.
      changes: a record.
      cuts: after how many of them there is a cut.
      models: of `MODELS`.

    Yields:
      the cut, the model, and the tree.
    """
    for cut in range(len(changes) + 1):
        if cut:
            disk.apply(changes[cut - 1])
        if cut in cuts:
            for model in models:
                yield cut, model, disk.tree(model)


def write_tree(tree: Tree, folder: Path) -> None:
    """Makes the files of a tree below an existing folder."""
    for path, data in tree.items():  # a folder comes before what is in it
        if data is None:
            (folder / path).mkdir()
        else:
            (folder / path).write_bytes(data)


def read_tree(folder: Path) -> Tree:
    """Returns the files below a folder."""
    return {
        str(path.relative_to(folder)): None if path.is_dir() else path.read_bytes()
        for path in sorted(folder.rglob("*"))
    }
