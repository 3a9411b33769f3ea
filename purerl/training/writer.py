"""Writes a run's metrics and checkpoints, in order, from one background thread.

The order matters: a checkpoint says how long metrics.jsonl was when it was taken, and is written
when the disk has all of that. Training does not wait for hashes or the disk.
"""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from purerl.core.errors import RunError, UserError, one_line
from purerl.machine import files, output
from purerl.machine.lock import FolderLock
from purerl.machine.state_arrays import Leaves, digest_leaves
from purerl.runs import checkpoint, checkpoint_folder
from purerl.runs.folder import Folder, note
from purerl.runs.metrics_file import MetricsFile, Record
from purerl.training.loggers import BackgroundLogger

TRIES = 2  # to save a checkpoint: many a fault passes


class RunWriter:
    """The only writer of a run's metrics.jsonl and checkpoints/."""

    def __init__(
        self,
        folder: Folder,
        metrics: MetricsFile,
        lock: FolderLock,
        keep: int,
        say: output.Say,
        worker: ThreadPoolExecutor,
        together: Sequence[Path],
    ) -> None:
        """Clears what a crash left in checkpoints/.

        Args:
          folder: the run's, as it is now.
          metrics: the run's metrics.jsonl.
          lock: on the folder.
          keep: how many of the newest checkpoints stay.
          say: prints a line.
          worker: the one thread that writes. Seeds that train together share it, so that none is
            ever more than one checkpoint ahead of another.
          together: the checkpoint folders of the seeds that train together, this one's included.
            They keep the checkpoints that all of them have.
        """
        self.folder, self.checkpoints = folder, folder.checkpoints
        files.make_folder(self.checkpoints)
        checkpoint_folder.clean(self.checkpoints)
        self.lock, self.metrics = lock, metrics
        self.signature = {name: folder.manifest[name] for name in ("run_id", "fingerprint")}
        self.signature["seed"] = folder.config["settings"]["seed"]
        self.keep, self.say, self.worker, self.together = keep, say, worker, together
        self.loggers: list[BackgroundLogger] = []
        self.last: Future[None] | None = None
        self.saving: Future[None] | None = None
        self.digest: str | None = None  # of the newest checkpoint written here
        self.broken: BaseException | None = None  # what ended the writing
        self.failures = 0
        self.last_failure = ""  # why the newest checkpoint could not be saved; "": it could

    def write(self, record: Record) -> None:
        """Hands a line to the thread that appends it to metrics.jsonl, and to the loggers."""
        self._submit(self._write, record)

    def save(self, record: Record, leaves: Leaves, meta: dict[str, Any], planned: bool) -> None:
        """Writes a line and saves a checkpoint; waits only while the last one is being written.

        Args:
          record: the line. A planned checkpoint adds the state's digest to it. (One that a signal
            asked for must leave no trace in metrics.jsonl.)
          leaves: `state_arrays.flatten` of the state.
          meta: what the checkpoint should say besides digest and length of metrics.jsonl.
          planned: whether the run would have saved here without being interrupted.
        """
        if self.saving is not None:
            self.saving.exception()  # waits: two copies of the state in memory are enough
        self.saving = self._submit(self._save, record, leaves, meta, planned)

    def best(self) -> float:
        """Returns the highest evaluation return that a checkpoint of this stage has, else -inf."""
        stages = checkpoint_folder.best_by_stage(self.checkpoints)
        return stages.get(self.signature["fingerprint"], (float("-inf"), 0))[0]

    def finish(self) -> None:
        """Waits until everything is on the disk; RunError if the last checkpoint is not."""
        if self.last is not None:
            self.last.exception()  # waits
        self._raise_broken()
        self.close()
        if self.last_failure:
            raise RunError(
                f"The last checkpoint could not be saved ({self.failures} failed in all): "
                f"{self.last_failure}. The newest on the disk is {self._newest()}. Mend that, and "
                "go on with --resume."
            )

    def close(self) -> None:
        """Stops the thread and the loggers."""
        self.worker.shutdown()
        self.metrics.file.close()
        for logger in self.loggers:
            logger.close()

    def _submit(self, job: Any, record: Record, *arguments: Any) -> Future[None]:
        self._raise_broken()
        self.last = self.worker.submit(self._do, job, dict(record), *arguments)
        return self.last

    def _do(self, job: Any, *arguments: Any) -> None:
        """Does a job, unless one before it has failed: the order must hold."""
        if self.broken is None:
            try:
                job(*arguments)
            except BaseException as error:
                self.broken = error

    def _raise_broken(self) -> None:
        """Raises what a job raised: no full disk, but a run that cannot go on, or a defect here."""
        if self.broken is not None:
            raise self.broken

    def _add(self, record: Record) -> None:
        self.metrics.add(record)
        for logger in self.loggers:
            logger.log(record)

    def _write(self, record: Record) -> None:
        self._add(record)
        self.lock.check()
        try:
            self.metrics.write()
        except OSError as error:
            self._failed(f"A line of metrics.jsonl could not be written: {one_line(error)}.")

    def _save(self, record: Record, leaves: Leaves, meta: dict[str, Any], planned: bool) -> None:
        digest = digest_leaves(leaves)
        self._add(record | {"digest": digest} if planned else record)
        for left in reversed(range(TRIES)):
            try:
                self.lock.check()
                about = meta | self.metrics.flush() | {"digest": digest, "run": self.signature}
                checkpoint.save(self.checkpoints, leaves, about)
                self.digest, self.last_failure = digest, ""
                self._tidy()
                return
            except RunError:
                raise
            except Exception as error:  # Orbax reports a full disk as any of several kinds
                self.last_failure = one_line(error)[:300]
                if not left:
                    what = f"The checkpoint of update {meta['update']} could not be saved"
                    self._failed(f"{what}: {self.last_failure}. The newest is {self._newest()}.")

    def _tidy(self) -> None:
        """Notes that there is a checkpoint, and deletes old ones; a fault here loses nothing."""
        try:
            if checkpoint_folder.common_updates(self.together):
                # It never again begins anew.
                self.folder = note(self.folder, had_checkpoint=True)
            checkpoint_folder.retain(self.checkpoints, self.keep, self.together)
        except (OSError, UserError) as error:
            self.say(f"An old checkpoint could not be deleted: {one_line(error)}")

    def _failed(self, message: str) -> None:
        self.failures += 1
        self.say(f"{message} Training goes on.")

    def _newest(self) -> str:
        try:
            found = checkpoint_folder.updates(self.checkpoints)
        except OSError:  # what made the save fail may make this fail too
            return "unknown"
        return f"of update {found[-1]}" if found else "none"
