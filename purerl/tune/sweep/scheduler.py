"""Carries out runs, as many at once as the machine takes; it knows nothing of sweeps.

All state is in the runs' folders and in the logs. Kill this process in any way: the next one finds
which runs are done, goes on with those that were interrupted, and waits for those that still train.
"""

import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import INTERRUPTED, SUCCESS, UserError
from purerl.machine import files, lock, signals
from purerl.machine.output import printable, warn
from purerl.report import run_reader
from purerl.runs import checkpoint_folder
from purerl.runs.folder import CHECKPOINTS

POLL = 0.2  # [s]
TAIL = 1 << 16  # [bytes] of a log in which its last line is looked for
LONGEST = 400  # letters of why a job failed
RUN = ("-m", "purerl.run")
CORES = 2  # of a run on a CPU, where NPROC says nothing else
PASSED_ON = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Job(NamedTuple):
    """One process of `python -m purerl.run`, which may train several seeds."""

    name: str
    words: tuple[str, ...]  # of the command line, without --resume auto
    folders: tuple[Path, ...]  # of its runs
    log: Path


class Ended(NamedTuple):
    """How a job ended."""

    job: Job
    status: str  # "done", "failed" or "stopped": it can go on
    said: str = ""  # the last line of one that failed


# --- what folders tell ---


def is_done(job: Job) -> bool:
    """Tells whether every run of a job has come to its end, and is saved."""
    return all(map(_has_ended, job.folders))


def _has_ended(folder: Path) -> bool:
    try:
        planned = run_reader.read(folder).planned
    except UserError:  # not begun, or half written: the run itself says what is wrong with it
        return False
    return planned is not None and planned in checkpoint_folder.updates(folder / CHECKPOINTS)


def is_locked(job: Job) -> bool:
    """Tells whether a process trains the job."""
    for folder in filter(Path.is_dir, job.folders):
        try:
            lock.FolderLock(folder, patience=0.0).close()
        except UserError:
            return True
        except OSError:  # the run itself will say what is wrong with it
            return False
    return False


def how_it_ended(job: Job) -> Ended:
    """Returns how a job ended that no process trains, by its folders and its log."""
    if is_done(job):
        return Ended(job, "done")
    lines = _last_lines(job.log)
    told = re.fullmatch(r"\[exit code (-?\d+)\]", lines[-1] if lines else "")  # whole, not torn
    code = told[1] if told else ""
    if code in ("", str(INTERRUPTED), str(SUCCESS)):
        return Ended(job, "stopped")
    ours = [i for i, line in enumerate(lines) if line.startswith("purerl: ")]
    why = lines[ours[-1] : -1] if ours else lines[-2:-1]  # ours may have lines below it
    said = " ".join(why).removeprefix("purerl: ")[:LONGEST] or "it said nothing"
    if code.startswith("-"):
        said = f"killed by {signal.Signals(-int(code)).name}"
    return Ended(job, "failed", said)


def _last_lines(log: Path) -> list[str]:
    """Returns the last lines of a log, from its last command on."""
    try:
        with files.open_file(log) as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL))
            text = file.read().decode(errors="replace")
    except OSError:
        return []
    lines = [line.strip() for line in text.replace("\r", "\n").split("\n") if line.strip()]
    starts = [i for i, line in enumerate(lines) if line.startswith("$ ")]
    return [printable(line) for line in lines[starts[-1] + 1 if starts else 0 :]]


# --- the machine ---


def find_gpus(environment: Mapping[str, str] = os.environ) -> list[str]:
    """Returns the GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them. No JAX."""
    if environment.get("JAX_PLATFORMS", "").startswith("cpu"):
        return []
    if "CUDA_VISIBLE_DEVICES" in environment:
        names = environment["CUDA_VISIBLE_DEVICES"].split(",")
        return [name.strip() for name in names if name.strip() not in ("", "-1")]
    try:
        words = ["nvidia-smi", "--list-gpus"]
        said = subprocess.run(words, capture_output=True, text=True, timeout=30).stdout
    except (OSError, subprocess.TimeoutExpired):
        return []
    found = [line for line in said.splitlines() if line.startswith("GPU ")]
    return [str(number) for number in range(len(found))]


def jobs_at_once(gpus: list[str], environment: Mapping[str, str] = os.environ) -> int:
    """Returns how many runs the machine takes: one for each GPU, else for every two cores.

    With NPROC, which is the number of XLA's threads in a run, it is cores / NPROC.
    """
    pinned = environment.get("NPROC", "")
    threads = int(pinned) if pinned.isdigit() and int(pinned) else CORES
    return len(gpus) or max(1, len(os.sched_getaffinity(0)) // threads)


def environment_of(slot: int, at_once: int, gpus: list[str]) -> dict[str, str]:
    """Returns what a job's environment has besides ours: its GPU, and its share of it.

    Args:
      slot: 0 .. at_once - 1, one that no other job has now.
      at_once: how many jobs run at once.
      gpus: as `find_gpus` returns them.
    """
    found = {}
    if len(gpus) > 1:
        found["CUDA_VISIBLE_DEVICES"] = gpus[slot % len(gpus)]
    if gpus and at_once > len(gpus):  # JAX alone would take three quarters of its memory
        share = 0.9 / -(-at_once // len(gpus))
        found["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{share:.2f}"
    return found


# --- running ---


def start(job: Job, more: Mapping[str, str], before: tuple[str, ...] = ()) -> subprocess.Popen:
    """Starts a job, or goes on with it; what it says is appended to its log.

    Args:
      job: no process trains it.
      more: of its environment, besides ours.
      before: words before the command, of a shell that prepares it.
    """
    words = [*RUN, *job.words, "--resume", "auto"]
    with files.writing(job.log):
        files.make_folder(job.log.parent)
        log = files.open_log(job.log)
        log.write(f"$ {shlex.join(['python', *words])}\n".encode())
    with log:
        # A session of its own: Ctrl-C in a terminal reaches this process alone, which passes it on.
        # A second one would end the run at once.
        return subprocess.Popen(
            [*before, sys.executable, *words], stdin=subprocess.DEVNULL, stdout=log,
            stderr=subprocess.STDOUT, env={**os.environ, **more}, start_new_session=True,
        )  # fmt: skip


def end(job: Job, code: int) -> Ended:
    """Notes in a job's log, if it takes that, how its process ended; returns how the job ended."""
    with contextlib.suppress(OSError), files.open_log(job.log) as log:
        log.write(f"[exit code {code}]\n".encode())
    return how_it_ended(job)


def carry_out(
    jobs: Iterable[Job],
    at_once: int,
    gpus: list[str],
    began: Callable[[Job], Any],
    ended: Callable[[Ended], Any],
) -> bool:
    """Carries jobs out; returns whether it was asked to stop.

    The next job is asked for when a slot is free, so that it may depend on those that have ended.
    SIGINT, SIGTERM and SIGHUP are passed on: runs save and stop. A second one stops them at once.

    Args:
      jobs: those that are done are not started again.
      at_once: how many processes.
      gpus: which they share, in turn.
      began: told of a job whose process has started.
      ended: told how each job ended.
    """
    active: dict[int, tuple[Job, subprocess.Popen | None]] = {}  # None: another still trains it
    received: list[int] = []
    todo = iter(jobs)

    def pass_on(number: int, frame: Any) -> None:
        if not received:
            name = signal.Signals(number).name
            warn(f"\n{name}: {len(active)} runs save and stop. Once more to stop them at once.")
        received.append(number)
        for _, process in active.values():
            _send(process, number)

    def begin(slot: int, job: Job) -> None:
        if is_locked(job):  # by a process that outlived its scheduler
            active[slot] = job, None
        elif is_done(job):
            active.pop(slot, None)
            ended(Ended(job, "done"))
        else:
            process = start(job, environment_of(slot, at_once, gpus))
            active[slot] = job, process
            if received:  # the signal came while it was started
                _send(process, received[0])
            began(job)

    with signals.handling(PASSED_ON, pass_on):
        try:
            more = True
            while active or (more and not received):
                for slot, (one, process) in list(active.items()):
                    if process is None and not received:
                        begin(slot, one)
                    elif process is None or process.poll() is not None:
                        del active[slot]
                        ended(_ended(one, process, bool(received)))
                while more and not received and len(active) < at_once:
                    job = next(todo, None)
                    more = job is not None
                    if job is not None:
                        begin(min(set(range(at_once)) - set(active)), job)
                time.sleep(POLL if active else 0.0)
        finally:  # an error of ours: nothing is left behind
            for _, process in active.values():
                _send(process, signal.SIGTERM)
            for one, process in active.values():
                if process is not None:
                    end(one, process.wait())
    return bool(received)


def _ended(job: Job, process: subprocess.Popen | None, asked: bool) -> Ended:
    if process is None:
        return Ended(job, "stopped")
    found = end(job, process.returncode)
    # One that was stopped while starting ends as the signal ends a program.
    return Ended(job, "stopped") if asked and found.status == "failed" else found


def _send(process: subprocess.Popen | None, number: int) -> None:
    """Passes a signal on; a terminal that is gone (SIGHUP) asks to save as SIGTERM does."""
    if process is not None:
        process.send_signal(signal.SIGTERM if number == signal.SIGHUP else number)
