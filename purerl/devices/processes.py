"""Several processes, on one host or many, that train one run together.

All compute the same; the first alone touches the run's folder. What only it can know (whether the
run may be written, where it goes on, from what state) it tells the others, its errors included.
"""

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np

from purerl.core.errors import FAILURE, RunError, StoppedError, UserError, one_line
from purerl.core.records import PyTree

HEARTBEAT = 30  # [s] after which a silent process is given up
LONGEST = 1 << 16  # [bytes] of what the first process can tell as text


def start(how: str) -> None:
    """Joins the other processes; to be called before JAX is used.

    Args:
      how: "" for a process by itself, "auto" (SLURM, Open MPI, Kubernetes, TPU: what JAX detects),
        or "HOST:PORT,NUM_PROCESSES,PROCESS_ID".
    """
    if not how:
        return
    # A signal stops all processes at the same update through `agreed`; JAX would take it from us.
    jax.config.update("jax_enable_preemption_service", False)
    words: dict[str, Any] = {}
    if how != "auto":
        try:
            address, number, process = how.split(",")
            words = {"num_processes": int(number), "process_id": int(process)}
        except ValueError as error:
            raise UserError(
                f"distributed is {how!r}; it must be auto or HOST:PORT,NUM_PROCESSES,PROCESS_ID, "
                "such as node1:1234,2,0."
            ) from error
        words["coordinator_address"] = address
    try:
        jax.distributed.initialize(heartbeat_timeout_seconds=HEARTBEAT, **words)
    except (ValueError, RuntimeError) as error:
        raise UserError(f"The processes did not find each other: {one_line(error)}") from error


def is_first() -> bool:
    """Tells whether this is the process that writes."""
    return jax.process_index() == 0


def in_first_process(function: Callable[[], Any]) -> Any:
    """Calls `function` in the first process only; its result (JSON) or error is everybody's."""
    if jax.process_count() == 1:
        return function()
    result, caught = None, None
    if is_first():
        try:
            result = function()
        except UserError as error:
            caught = error
    told = json.dumps([result, str(caught) if caught else None]).encode()
    buffer = np.zeros(LONGEST, np.uint8)
    buffer[: len(told)] = np.frombuffer(told[:LONGEST], np.uint8)
    result, problem = json.loads(of_first(buffer).tobytes().rstrip(b"\0"))
    if problem:
        raise UserError(problem)
    return result


def kept_by_first(function: Callable[[], Any]) -> Any:
    """Calls `function` in the first process only, which keeps the result; its error is everybody's.

    Of the others it is None.
    """
    kept: list[Any] = []
    in_first_process(lambda: kept.append(function()))
    return kept[0] if kept else None


def of_first(tree: PyTree) -> PyTree:
    """Returns the first process's arrays, of the same shapes everywhere, bit for bit."""
    from jax.experimental.multihost_utils import process_allgather

    return jax.tree.map(lambda x: np.asarray(process_allgather(x))[0], tree)


def agreed(stop: Callable[[], bool]) -> Callable[[], bool]:
    """Returns a question that every process answers with yes as soon as one of them would."""
    if jax.process_count() == 1:
        return stop
    from jax.experimental.multihost_utils import process_allgather

    return lambda: bool(np.any(process_allgather(np.asarray(stop()))))


@contextmanager
def fail_together() -> Iterator[None]:
    """Ends this process at once when it cannot go on with the others, or they not with it.

    An orderly end would wait for processes that are gone, or that wait for this one.
    """
    try:
        yield
    except (UserError, RunError, StoppedError, SystemExit):
        raise
    except BaseException as error:
        if jax.process_count() == 1:
            raise
        what = f"process {jax.process_index()} of {jax.process_count()} cannot go on, or another is"
        cure = "Start all of them again, with --resume."
        print(f"purerl: {what} gone: {one_line(error)[:300]} {cure}", file=sys.stderr, flush=True)
        os._exit(FAILURE)


class Silent:
    """Stands for the progress display and the writer of a process that is not the first."""

    digest = None

    def __init__(self, checkpoints: Path | None = None) -> None:
        """Names the folder of the run's checkpoints, for messages."""
        self.checkpoints = checkpoints
        self.say = self.show = self.write = self._nothing
        self.save = self.finish = self.close = self._nothing

    def _nothing(self, *arguments: Any) -> None:
        """Does nothing."""
