"""Videos while a run trains: a process of low priority renders the policy at evaluations.

Training never waits for it and shares nothing with it but the files, so it changes no bit. There is
one such process at a time; what was evaluated meanwhile is left out, but for the newest.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from purerl.core.errors import one_line
from purerl.runs import checkpoint

LOWEST_PRIORITY = 19  # of a Unix process


class RunVideo:
    """Takes a run's records, as a logger does, and starts `python -m purerl.render` by them."""

    def __init__(
        self,
        folder: Path,
        stop: Callable[[], bool],
        say: Callable[[str], None],
        command: Callable[[Path], list[str]] | None = None,
    ) -> None:
        """Renders nothing yet.

        Args:
          folder: the run's.
          stop: tells whether the run was asked to stop: then the last video is not waited for.
          say: prints a line.
          command: folder -> words of the command that renders; for tests.
        """
        self.folder, self.stop, self.say = folder, stop, say
        self.command = command or render_command
        self.wanted: int | None = None  # the newest evaluation that has no video yet
        self.process: subprocess.Popen[bytes] | None = None
        self.output: IO[bytes] | None = None
        self.dropped = False

    def log(self, record: dict[str, Any]) -> None:
        """Takes a record: looks after the process, and starts the next if there is cause."""
        if "eval/episode_return" in record:
            self.wanted = record["update"]
        self._guarded(self._look)

    def close(self) -> None:
        """Waits for the last video, unless the run was asked to stop."""
        self._guarded(self._finish)

    def _guarded(self, job: Callable[[], None]) -> None:
        """Whatever a video does, training goes on."""
        if self.dropped:
            return
        try:
            job()
        except Exception as error:
            self.dropped = True
            self.say(f"No more videos are made: {one_line(error)} Training goes on.")

    def _finish(self) -> None:
        self._look()
        if self.process is not None or self._due():
            self.say("Waiting for the last video; Ctrl-C leaves it out.")
        while self.process is not None and not self.stop():
            time.sleep(0.1)
            self._look()
        if self.process is not None:
            self.process.terminate()
            self.process.wait()
            self.process = None

    def _look(self) -> None:
        if self.process is not None and self.process.poll() is not None:
            self._report()
        if self.process is None and self._due() and not self.stop():
            self._start()

    def _due(self) -> bool:
        """Tells whether there is a checkpoint as new as the evaluation that is wanted.

        An evaluation without a checkpoint of its own is shown by the next one.
        """
        found = checkpoint.updates(self.folder / "checkpoints")
        return self.wanted is not None and bool(found) and found[-1] >= self.wanted

    def _start(self) -> None:
        self.wanted = None
        self.output = tempfile.TemporaryFile()  # noqa: SIM115 (closed in _report)
        self.process = subprocess.Popen(
            self.command(self.folder),
            stdin=subprocess.DEVNULL,
            stdout=self.output,
            stderr=self.output,
            env=os.environ | {"JAX_PLATFORMS": "cpu"},  # a GPU's memory is the training's
            start_new_session=True,  # Ctrl-C is meant for the training, which ends it if need be
        )
        os.setpriority(os.PRIO_PROCESS, self.process.pid, LOWEST_PRIORITY)

    def _report(self) -> None:
        """Says where the video is; RuntimeError with the process's last line if it failed."""
        assert self.process is not None and self.output is not None
        code, self.process = self.process.returncode, None
        self.output.seek(0)
        lines = [line for line in self.output.read().decode(errors="replace").split("\n") if line]
        self.output.close()
        last = lines[-1] if lines else ""
        if code:
            raise RuntimeError(last or f"the renderer ended with code {code}.")
        self.say(f"Video: {last}")


def render_command(folder: Path) -> list[str]:
    """Returns the command that renders the newest checkpoint, by an engine that a CPU has.

    The newest when it comes to read it: one chosen now may be deleted until then.
    """
    return [sys.executable, "-m", "purerl.render", str(folder), "--engine", "auto"]
