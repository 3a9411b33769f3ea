"""Which files are read, by whatever library: Linux tells (inotify). Python sees only its own."""

import contextlib
import ctypes
import os
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

from purerl.core.errors import UserError

READ, EVENT = 1, struct.Struct("iIII")  # IN_ACCESS; of a file an event has no more than its number


@contextlib.contextmanager
def reads_among(files: Iterable[Path]) -> Iterator[set[Path]]:
    """Yields a set that has, when this ends, those of the files, or links, that were read."""
    libc, found = ctypes.CDLL(None), set[Path]()
    handle = libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
    with open(handle, "rb", 0) as events:
        whose = {libc.inotify_add_watch(handle, os.fsencode(file), READ): file for file in files}
        if -1 in whose:
            raise UserError(f"{whose[-1]} cannot be watched: it, or one of too many files here.")
        yield found
        told = events.read(1 << 20) or b""  # more than Linux keeps
    found.update(whose[number] for number, *_ in EVENT.iter_unpack(told) if number in whose)
