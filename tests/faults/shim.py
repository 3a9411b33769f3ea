"""Builds `shim.c` and arms it: a process started under it records its changes of files, or fails.

    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(words, env=shim.environment(shim.build(Path(folder))))

The process that was started so arms it with `recording`, `tracing` and `failing`. It needs Linux
and a C compiler (`cc`).
"""

import contextlib
import ctypes
import errno
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

SOURCE = Path(__file__).with_name("shim.c")
# In the order of the bits in `shim.c`.
KINDS = (
    "open", "create", "read", "write", "fsync", "truncate", "rename", "link", "mkdir", "remove",
    "list", "lock", "stat",
)  # fmt: skip
HALF = 0  # instead of an errno: a read or a write of half the bytes


class Fault(NamedTuple):
    """Which call fails, and how; picklable as JSON."""

    kinds: tuple[str, ...]
    nth: int  # of these kinds, counted from 1
    error: str  # "EIO", ...; "half": half of the bytes are read or written
    once: bool = True  # or every one of these kinds from then on

    def numbers(self) -> tuple[int, int, int, int]:
        """Returns it as the shim takes it."""
        kinds = sum(1 << KINDS.index(kind) for kind in self.kinds)
        number = HALF if self.error == "half" else getattr(errno, self.error)
        return kinds, self.nth, number, int(self.once)

    def __str__(self) -> str:
        """Returns it in words."""
        often = "" if self.once else " and all after it"
        return f"{self.error} at {'|'.join(self.kinds)} {self.nth}{often}"


def has_compiler() -> bool:
    """Tells whether the shim can be built here."""
    return shutil.which("cc") is not None


def build(folder: Path) -> Path:
    """Compiles the shim into `folder`; returns the library."""
    library = folder / "shim.so"
    words = ["cc", "-O1", "-Wall", "-shared", "-fPIC", "-o", str(library), str(SOURCE)]
    subprocess.run([*words, "-ldl", "-lpthread"], check=True)
    return library


def environment(library: Path, **variables: str) -> dict[str, str]:
    """Returns the environment of a process that the shim stands before."""
    return {**os.environ, "LD_PRELOAD": str(library), **variables}


def armed_by(root: Path, record: Path | None = None, fault: Fault | None = None) -> dict[str, str]:
    """Returns the variables that arm a process from its first call on."""
    variables = {"SHIM_ROOT": str(root.resolve())}
    if record:
        variables["SHIM_RECORD"] = str(record)
    if fault:
        variables["SHIM_FAULT"] = ",".join(map(str, fault.numbers()))
    return variables


def arm(
    root: Path, record: Path | None = None, trace: Path | None = None, fault: Fault | None = None
) -> None:
    """Arms this process for the files below `root`.

    Args:
      root: an existing folder.
      record: a file outside of it, to which changes are appended; `disk.read_record` reads it.
      trace: a file outside of it, to which every call is appended, as "write /path".
      fault: what fails.
    """
    texts = [
        None if path is None else str(path).encode() for path in (root.resolve(), record, trace)
    ]
    _library().shim_arm(*texts, *(fault.numbers() if fault else (0, 0, 0, 1)))


def disarm() -> str:
    """Disarms this process; returns what the fault met, as "EIO write /path", "" for nothing."""
    _library().shim_disarm()
    return fired()


def fired() -> str:
    """Returns what the fault has met so far; "" for nothing."""
    return ctypes.c_char_p(_library().shim_fired()).value.decode()  # type: ignore[union-attr]


@contextlib.contextmanager
def armed(*arguments: Path, **options: Path | Fault | None) -> Iterator[None]:
    """Arms this process for a while."""
    arm(*arguments, **options)  # type: ignore[arg-type]
    try:
        yield
    finally:
        disarm()


def loaded() -> bool:
    """Tells whether the shim stands before this process."""
    return hasattr(ctypes.CDLL(None), "shim_arm")


def _library() -> ctypes.CDLL:
    library = ctypes.CDLL(None)
    text = ctypes.c_char_p
    library.shim_arm.argtypes = [
        text, text, text, ctypes.c_uint, ctypes.c_long, ctypes.c_int, ctypes.c_int,
    ]  # fmt: skip
    library.shim_arm.restype = library.shim_disarm.restype = None
    library.shim_fired.restype = ctypes.c_void_p
    return library
