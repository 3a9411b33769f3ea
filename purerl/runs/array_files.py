"""A folder of arrays on the disk, as Orbax writes and reads it: the one module that knows Orbax."""

import logging
import os
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np


def write(path: Path, arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> None:
    """Writes arrays and JSON values as one folder, which appears whole or not at all."""
    args = _orbax().args
    whole = args.Composite(state=args.StandardSave(arrays), meta=args.JsonSave(meta))
    with _checkpointer() as checkpointer:
        checkpointer.save(path.absolute(), whole)


def read(path: Path, like: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Reads arrays of the names, shapes and dtypes of `like`; raises what Orbax raises."""
    args = _orbax().args
    with _checkpointer() as checkpointer:
        wanted = args.Composite(state=args.StandardRestore(like))
        return checkpointer.restore(path.absolute(), wanted).state


def flush(path: Path) -> None:
    """Forces a checkpoint to the disk before an older one is deleted: Orbax calls no fsync."""
    for file in [*path.rglob("*"), path, path.parent]:
        handle = os.open(file, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _checkpointer() -> Any:
    """Returns what saves and loads; of several processes the first does, without the others."""
    ocp = _orbax()
    if jax.process_count() == 1:
        return ocp.Checkpointer(ocp.CompositeCheckpointHandler())
    alone = ocp.options.MultiprocessingOptions(
        primary_host=0, active_processes={0}, barrier_sync_key_prefix="first"
    )
    handler = ocp.CompositeCheckpointHandler(
        state=ocp.StandardCheckpointHandler(multiprocessing_options=alone),
        meta=ocp.JsonCheckpointHandler(multiprocessing_options=alone),
        composite_options=ocp.CompositeOptions(multiprocessing_options=alone),
    )
    return ocp.Checkpointer(handler, multiprocessing_options=alone)


def _orbax() -> Any:
    """Imports Orbax late (0.3 s), and without its running commentary."""
    for name in ("absl", "asyncio"):  # errors are reported by us, once for a save
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if sys.unraisablehook is sys.__unraisablehook__:
        sys.unraisablehook = _print_unraisable
    import orbax.checkpoint

    return orbax.checkpoint


def _print_unraisable(raised: Any) -> None:
    """Prints what could not be raised, but not what a failed save's unfinished writes end with.

    They end one by one, in threads of the storage library, after the failure has been reported.
    """
    if str(raised.exc_value) != "Event loop is closed":
        sys.__unraisablehook__(raised)
