"""Runs run commands under the shim: many in one worker process, which is replaced when it hangs."""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from tests.faults import shim

HANGS = 60.0  # [s] without an answer; the first one waits for imports and compilation too
BEGINS = 240.0


class Answer(NamedTuple):
    """How a command ended."""

    code: int | None  # None: by an exception, or it hung
    out: str
    err: str
    fired: str = ""  # what the fault met, "" for nothing
    seconds: float = 0.0
    hung: bool = False
    stuck: str = ""  # where a thread was left that would not let the process end

    @property
    def said(self) -> str:
        """Everything that it printed."""
        return self.out + self.err


class Worker:
    """One process that carries out commands, and is replaced when one of them hangs."""

    def __init__(self, library: Path, folder: Path) -> None:
        """Keeps the worker's own error output in `folder`."""
        self.library, self.folder = library, folder
        self.process: subprocess.Popen[str] | None = None
        self.answered = 0

    def run(
        self,
        words: list[str],
        root: Path,
        record: Path | None = None,
        trace: Path | None = None,
        fault: shim.Fault | None = None,
        stop_at: str | None = None,
        armed_at_stop: bool = False,
    ) -> Answer:
        """Carries out a command; see `worker.carry_out`."""
        request = dict(words=words, root=root, record=record, trace=trace, fault=fault,
                       stop_at=stop_at, armed_at_stop=armed_at_stop)  # fmt: skip
        return self._ask(json.dumps(request, default=str))

    def end(self, timeout: float = 30.0) -> str:
        """Ends the process as a run's process ends; returns where it hangs, "" if it does not."""
        process, self.process, self.answered = self.process, None, 0
        if process is None:
            return ""
        assert process.stdin is not None and process.stdout is not None
        process.stdin.close()
        try:
            process.wait(timeout)
        except subprocess.TimeoutExpired:
            return self._kill(process)
        finally:
            process.stdout.close()
        return ""

    def _ask(self, request: str) -> Answer:
        process = self.process = self.process or self._start()
        assert process.stdin is not None and process.stdout is not None
        begin = time.monotonic()
        try:
            process.stdin.write(request + "\n")
            process.stdin.flush()
            line = _read_line(process.stdout, HANGS if self.answered else BEGINS)
        except BrokenPipeError:
            line = ""
        self.answered += 1
        if line:
            return Answer(**json.loads(line))
        self.process, self.answered = None, 0
        hung = line is None
        stacks = self._kill(process)
        seconds = time.monotonic() - begin
        how = "it hangs" if hung else f"the process died ({process.returncode})"
        return Answer(None, "", f"{how}:\n{stacks}", "", seconds, hung)

    def _start(self) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "tests.faults.worker"],
            env=shim.environment(self.library),
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors().open("w"),
            text=True,
        )  # fmt: skip

    def _kill(self, process: subprocess.Popen[str]) -> str:
        """Ends a process that does not end; returns where its threads were."""
        if process.poll() is None:
            process.send_signal(signal.SIGUSR1)  # writes the threads' stacks
            time.sleep(1.0)
            process.kill()
            process.wait()
        return self._errors().read_text()[-6000:]

    def _errors(self) -> Path:
        return self.folder / "worker.log"


@contextlib.contextmanager
def workplace() -> Iterator[tuple[Path, Worker]]:
    """Yields an empty folder, in memory where there is one, and a worker with the shim before it.

    The shim tells what would be on the disk, so the disk itself need not be slow.
    """
    memory = Path("/dev/shm")
    place = memory if os.access(memory, os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="purerl-", dir=place) as name:
        folder = Path(name).resolve()
        (folder / "own").mkdir()
        worker = Worker(shim.build(folder / "own"), folder / "own")
        try:
            yield folder, worker
        finally:
            worker.end()


def fresh(folder: Path) -> Path:
    """Makes an empty folder, whatever was there."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def _read_line(stream: Any, timeout: float) -> str | None:
    """Returns a line, "" if there are no more, None if it does not come in time."""
    with selectors.DefaultSelector() as selector:
        selector.register(stream, selectors.EVENT_READ)
        return stream.readline() if selector.select(timeout) else None
