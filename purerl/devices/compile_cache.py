"""The cache of compiled programs on disk: an entry is taken only if it is what was stored.

An entry is machine code. With one bit flipped, or under another's name, it ends the process or
changes the result, at every start. JAX takes an entry as it is, but lets `etils` open the folder as
the kind of path that its prefix stands for. The kind here adds to each entry a hash of it and of
its name. An entry without the right one is not there, so the program is compiled and stored anew.

Other programs can use the same folder: they read past the hash. What they store has none.
"""

import contextlib
import functools
import hashlib
import os
import sys
import threading
from collections.abc import Callable
from typing import Any

import jax
from etils import epath
from jax.experimental.compilation_cache import compilation_cache

PREFIX = "purerl-checked://"
ENTRY = "-cache"  # the end of JAX's names of entries
MARK = b"\npurerl sha256 "  # between an entry and its hash
LENGTH = len(MARK) + hashlib.sha256().digest_size
LocalPath: Any = type(epath.Path(os.sep))


def use(folder: str) -> None:
    """Makes JAX keep compiled programs in a folder; one that is not local, it keeps unchecked."""
    if "://" not in folder:
        folder = PREFIX + os.path.abspath(folder)
    if jax.config.values["jax_compilation_cache_dir"] != folder:
        jax.config.update("jax_compilation_cache_dir", folder)
        compilation_cache.reset_cache()  # JAX may have opened another one


def in_use() -> str:
    """Returns the folder that JAX keeps compiled programs in, "" if it has none."""
    return (jax.config.values["jax_compilation_cache_dir"] or "").removeprefix(PREFIX)


def kept(name: str, make: Callable[[], bytes]) -> bytes:
    """Returns what `make` returns, from the folder if some process has made it under this name.

    The name has to say all that the result depends on, such as by a hash.
    """
    folder = in_use() if jax.config.values["jax_enable_compilation_cache"] else ""
    if not folder or "://" in folder:
        return make()
    entry = CheckedPath(folder, "kept", name + ENTRY)  # JAX looks in no folder of its folder
    with contextlib.suppress(OSError):
        return entry.read_bytes()
    made = make()
    with contextlib.suppress(OSError):  # a disk that is full, or nobody's to write on
        entry.parent.mkdir(exist_ok=True)
        entry.write_bytes(made)
    return made


def seal(name: str, program: bytes | memoryview) -> bytes:
    """Returns what follows an entry's program: a hash of it and of the entry's name."""
    digest = hashlib.sha256(name.encode() + b"\0")
    digest.update(program)
    return MARK + digest.digest()


@epath.register_path_cls(PREFIX)
class CheckedPath(LocalPath):
    """A path of the cache; entries are written whole or not at all, and are there if sound."""

    def __new__(cls, *parts: Any) -> Any:
        """Makes it of parts, of which the first may have the prefix."""
        return super().__new__(cls, *map(_plain, parts))

    def __init__(self, *parts: Any) -> None:
        """Does the same from Python 3.12 on."""
        if sys.version_info >= (3, 12):
            super().__init__(*map(_plain, parts))

    def exists(self) -> bool:
        """Tells whether it is there."""
        try:
            return self.read_bytes() is not None if self.name.endswith(ENTRY) else super().exists()
        except OSError:
            return False

    def read_bytes(self) -> bytes:
        """Returns what was stored; of an entry that is not sound, FileNotFoundError."""
        content = super().read_bytes()
        if not self.name.endswith(ENTRY):
            return content
        end = content[-LENGTH:]
        if seal(self.name, memoryview(content)[:-LENGTH]) == end:
            return content[:-LENGTH]
        if end.startswith(MARK):  # else another program's, or the beginning of one
            _tell(str(self))
            with contextlib.suppress(OSError):
                self.unlink()
        raise FileNotFoundError(str(self))

    def write_bytes(self, data: bytes) -> int:
        """Stores it; another process may read it meanwhile, or this one be killed."""
        if not self.name.endswith(ENTRY):
            return super().write_bytes(data)
        draft = LocalPath(f"{self}.{os.getpid()}.{threading.get_ident()}")
        try:
            draft.write_bytes(data + seal(self.name, data))
            draft.replace(self)
        finally:
            draft.unlink(missing_ok=True)
        return len(data)


@functools.cache
def _tell(path: str) -> None:
    """Says once that an entry is not sound."""
    said = f"purerl: {path} is not as it was stored, so it is compiled anew."
    print(said, file=sys.stderr, flush=True)


def _plain(part: Any) -> str:
    return os.fspath(part).removeprefix(PREFIX)
