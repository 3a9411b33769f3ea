"""A folder of arrays on the disk, as Orbax writes and reads it: the one module that knows Orbax."""

import contextlib
import logging
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np


def write(folder: Path, arrays: dict[str, np.ndarray]) -> None:
    """Writes arrays into a new folder; raises what Orbax raises."""
    with _checkpointer() as checkpointer, _plain(folder) as plain:
        checkpointer.save(plain, _orbax().args.PyTreeSave(arrays))


def read(folder: Path, like: dict[str, Any]) -> dict[str, np.ndarray]:
    """Reads arrays of the names, shapes and dtypes of `like`; raises what Orbax raises."""
    ocp = _orbax()
    wanted = {key: jax.ShapeDtypeStruct(x.shape, x.dtype) for key, x in like.items()}
    kinds = {key: ocp.RestoreArgs(np.ndarray, dtype=x.dtype) for key, x in like.items()}
    how = ocp.args.PyTreeRestore(wanted, restore_args=kinds, partial_restore=True)
    with _checkpointer() as checkpointer, _plain(folder) as plain:
        found = checkpointer.restore(plain, how)
    for key, x in found.items():
        if not isinstance(x, np.ndarray):  # Orbax hands back what it was given
            raise ValueError(f"leaf {key} is not there")
    return found


@contextlib.contextmanager
def _plain(folder: Path) -> Iterator[Path]:
    r"""Yields a path to a folder in which Orbax and TensorStore find no syntax of theirs.

    To them `[1]` and `*` are patterns, `\` is `/`, and `gs:` begins an address.
    """
    place = folder.absolute()
    with contextlib.ExitStack() as stack:
        if not re.fullmatch(r"[\w/. +,=@~-]*", str(place)):
            above = os.open(place.parent, os.O_PATH | os.O_DIRECTORY)
            stack.callback(os.close, above)
            place = Path(f"/proc/self/fd/{above}", place.name)
        yield place


def _checkpointer() -> Any:
    """Returns what saves and loads; of several processes the first does, without the others."""
    ocp = _orbax()
    if jax.process_count() == 1:
        return ocp.Checkpointer(ocp.PyTreeCheckpointHandler())
    alone = ocp.options.MultiprocessingOptions(
        primary_host=0, active_processes={0}, barrier_sync_key_prefix="first"
    )
    handler = ocp.PyTreeCheckpointHandler(multiprocessing_options=alone)
    return ocp.Checkpointer(handler, multiprocessing_options=alone)


def _orbax() -> Any:
    """Imports Orbax late (0.3 s), and without its running commentary."""
    for name in ("absl", "asyncio"):  # errors are reported by us, once for a save
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if sys.unraisablehook is sys.__unraisablehook__:
        sys.unraisablehook = _print_unraisable
    import orbax.checkpoint

    return orbax.checkpoint


def _print_unraisable(raised: Any, show: Any = sys.__unraisablehook__) -> None:
    """Prints what could not be raised, but not what a failed save's unfinished writes end with.

    They end one by one, in threads of the storage library, after the failure has been reported.
    """
    if str(raised.exc_value) != "Event loop is closed":
        show(raised)  # while Python ends, `sys` is None
