"""Jobs as an array of SLURM, by submitit; `cluster=local` runs them as processes here."""

import contextlib
import os
import shutil
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from purerl.core.errors import INTERRUPTED, UserError, one_line
from purerl.machine.files import read_json, write_json
from purerl.tune.sweep.scheduler import Job, end, is_done, is_locked, start

FOLDER, IDS = "slurm", "jobs.json"
# SLURM tells every process of a job that its time is over; a run would die of that signal.
DEAF = ("sh", "-c", 'trap "" USR1 USR2; exec "$@"', "sh")


class Task:
    """What a task of the array does; submitit pickles it before it is called."""

    def __init__(self, job: Job) -> None:
        """Keeps the job."""
        self.job = job
        self.process: subprocess.Popen | None = None

    def __call__(self) -> str:
        """Carries the job out, or goes on with it; returns how it ended."""
        if is_done(self.job) or is_locked(self.job):
            return "done, or trained by another process"
        self.process = start(self.job, {}, DEAF)
        return end(self.job, self.process.wait()).status

    def checkpoint(self) -> Any:
        """Saves the runs before the time is over, and puts the job into the queue again."""
        from submitit.helpers import DelayedSubmission

        if self.process is not None:
            # It is called in a signal's handler, which comes while `wait` holds its lock.
            with contextlib.suppress(ProcessLookupError, ChildProcessError):
                os.kill(self.process.pid, signal.SIGTERM)
                found = os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOWAIT)
                killed = found is None or found.si_code != os.CLD_EXITED
                end(self.job, INTERRUPTED if found is None or killed else found.si_status)
        return DelayedSubmission(Task(self.job))


def parameters(text: str) -> dict[str, int | str]:
    """Reads `timeout_min=240,gpus_per_node=1`; whole numbers are numbers."""
    found: dict[str, int | str] = {}
    for part in text.split(","):
        name, equals, value = (word.strip() for word in part.partition("="))
        if not (name and equals and value):
            raise UserError(f"slurm is {text!r}; give it as timeout_min=240,gpus_per_node=1.")
        found[name] = int(value) if value.isdigit() else value
    return found


def check(text: str, folder: Path) -> None:
    """Raises UserError unless the parameters can be read, and there is a SLURM to take jobs."""
    is_slurm = parameters(text).get("cluster", "slurm") == "slurm"
    if is_slurm and "%" in str(folder.absolute()):
        raise UserError(f"{folder} has a %, which SLURM reads as a pattern: use another --name.")
    if is_slurm and shutil.which("sbatch") is None:
        raise UserError(
            "There is no SLURM on this machine (no sbatch): give the command on a login node, or "
            "try it here with --slurm cluster=local."
        )


def submit(
    jobs: Sequence[Job], folder: Path, text: str, at_once: int
) -> tuple[list[str], list[str]]:
    """Submits the jobs that are neither done nor in the queue.

    Args:
      jobs: all jobs of the array.
      folder: of the sweep; submitit's files go to `slurm/` in it.
      text: submitit's parameters.
      at_once: tasks at once; 0: as many as SLURM likes.

    Returns:
      The names of what was submitted, and of what was in the queue or trained already.
    """
    import submitit

    given = parameters(text)
    cluster = str(given.pop("cluster", "slurm"))
    place = folder / FOLDER
    try:
        executor = submitit.AutoExecutor(folder=place, cluster=cluster)
        if at_once and cluster != "local":
            given["slurm_array_parallelism"] = at_once
        executor.update_parameters(**given)
    except Exception as error:  # its own, and of many kinds
        raise UserError(f"submitit: {one_line(error)}") from error
    file = place / IDS
    known = read_json(file) if file.exists() else {}
    open_ones = [job for job in jobs if not is_done(job)]
    todo = [job for job in open_ones if not _is_under_way(job, place, cluster, known)]
    if todo:
        try:
            submitted = executor.submit_array([Task(job) for job in todo])
        except Exception as error:
            raise UserError(f"submitit: {one_line(error)}") from error
        ids = {job.name: one.job_id for job, one in zip(todo, submitted, strict=True)}
        write_json(file, known | ids)
    return [job.name for job in todo], [job.name for job in open_ones if job not in todo]


def _is_under_way(job: Job, place: Path, cluster: str, known: dict[str, str]) -> bool:
    """Tells whether SLURM has the job, waiting or running; here its id is that of a process."""
    if (locked := is_locked(job)) or job.name not in known:
        return locked
    if cluster == "local":
        return Path("/proc", known[job.name]).exists()
    from submitit import SlurmJob

    return not SlurmJob(place, known[job.name]).done(force_check=True)
