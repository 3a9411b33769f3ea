"""Makes every call that a short run makes to its files fail, one at a time, and sees what it does.

python -m tests.long.io_faults [--every 5] [--sample 100] [--only start] [-- EXPERIMENT [...]]

A run is made three times: from the start, resumed after a stop, and while it is asked to stop.
Each call below its folder (open, read, write, fsync, rename, mkdir, remove, list, stat, ...) fails
once, with each error that it may meet (EIO, ENOSPC, EACCES, EMFILE, half of the bytes). And from
some calls on, a disk stays full, descriptors run out, or every call fails.

The run must end with the digest and metrics.jsonl (the clock aside) of one that nobody disturbed,
or with one line that says what is wrong, no traceback, and no hang. What it said must be true: a
run that is done is done, and one that is saved is saved. Without the fault, the same command (with
--resume, if there is a folder) must then end as the undisturbed run, and go back behind no
checkpoint that was there before. No checkpoint is set aside as damaged. Exit code 0 if all hold.
"""

import argparse
import collections
import itertools
import random
import re
import shutil
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from purerl.core.errors import INTERRUPTED, SUCCESS
from tests.faults import verdicts
from tests.faults.commands import Answer, Worker, fresh, workplace
from tests.faults.shim import Fault
from tests.faults.verdicts import SHORT, STOP_AT, Whole, command

# What may happen to a call, whatever the disk.
ERRORS = {
    "open": ("EIO", "EACCES", "EMFILE"),
    "create": ("EIO", "ENOSPC", "EACCES", "EMFILE"),
    "read": ("EIO", "half"),
    "write": ("EIO", "ENOSPC", "half"),
    "fsync": ("EIO", "ENOSPC"),
    "truncate": ("EIO", "EACCES"),
    "rename": ("EIO", "ENOSPC", "EACCES"),
    "link": ("EIO", "ENOSPC"),
    "mkdir": ("EIO", "ENOSPC", "EACCES"),
    "remove": ("EIO", "EACCES"),
    "list": ("EIO", "EACCES", "EMFILE"),
    "lock": ("ENOLCK",),
    "stat": ("EIO", "EACCES"),
}
# What may stay so: a full disk, no descriptors, a disk that is gone, one that became read-only.
LASTING = {
    "ENOSPC": ("create", "write", "fsync", "truncate", "rename", "link", "mkdir"),
    "EMFILE": ("open", "create", "list"),
    "EIO": tuple(kind for kind in ERRORS if kind not in ("stat", "lock")),
    "EROFS": ("create", "write", "truncate", "rename", "link", "mkdir", "remove"),
}
LASTING_EVERY = 25  # of so many calls, a lasting fault begins at one


class Situation(NamedTuple):
    """In which life of the run calls fail."""

    name: str
    begun: bool = False  # it is a resume
    stop_at: str | None = None  # calls fail from the moment on when it is asked to stop


SITUATIONS = (
    Situation("start"),
    Situation("resume", begun=True),
    Situation("stop", False, STOP_AT),
)


class Case(NamedTuple):
    """One fault in one situation."""

    situation: Situation
    fault: Fault
    group: tuple[str, ...]  # like others: the situation, the error, the call and the kind of file


class Failure(NamedTuple):
    """A fault that a run does not survive."""

    case: Case
    met: str  # the call that failed
    wrong: str
    said: str


class Found(NamedTuple):
    """What came of all faults."""

    met: int  # how many faults met a call
    told: int  # how many commands ended with an error
    failures: list[Failure]


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the check; returns its exit code."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "tests.long.io_faults", description=__doc__, formatter_class=plain
    )
    names = [situation.name for situation in SITUATIONS]
    parser.add_argument("--every", type=int, default=1, help="of so many like faults, one is made")
    parser.add_argument("--sample", type=int, default=0, help="faults, of all kinds; 0: all")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--only", choices=names, help="in which situation")
    parser.add_argument("--part", default="0/1", help="I/N: part I of N, for N processes")
    parser.add_argument("words", nargs="*", help="-- EXPERIMENT [--option value ...]")
    options = parser.parse_args(arguments)
    situations = [one for one in SITUATIONS if options.only in (None, one.name)]
    first, parts = map(int, options.part.split("/"))
    part = slice(first, None, parts)
    found = fault_all(
        options.words or SHORT, situations, options.every, options.sample, options.seed, part
    )
    return 1 if found.failures else 0


def fault_all(
    words: list[str], situations: Iterable[Situation], every: int, sample: int = 0, seed: int = 0,
    part: slice = slice(None),
) -> Found:  # fmt: skip
    """Makes the faults, and prints what came of them."""
    begin = time.monotonic()
    with workplace() as (folder, worker):
        whole = verdicts.undisturbed(worker, words, fresh(folder / "whole"))
        stopped = fresh(folder / "stopped")
        worker.run(command(words, stopped), stopped, stop_at=STOP_AT)
        before = verdicts.saved(stopped)
        cases = []
        for situation in situations:
            calls = trace(worker, words, situation, folder)
            found = cases_of(situation, calls)
            print(f"{situation.name}: {len(calls)} calls, {len(found)} faults", flush=True)
            cases += found
        cases = choose(cases, every, sample, seed)[part]
        found = try_all(worker, whole, cases, folder, before)
    _print_table(found)
    print(f"{len(cases)} faults, {found.met} met a call, {found.told} told as errors: "
          f"{len(found.failures)} failures; {time.monotonic() - begin:.0f} s")  # fmt: skip
    return found


def trace(worker: Worker, words: list[str], situation: Situation, folder: Path) -> list[list[str]]:
    """Returns the calls of a command in a situation: kind and path below its place."""
    name = f"traced-{situation.name}"
    place, log = prepare(situation, folder, name), folder / "own" / name
    ask(worker, words, situation, place, trace=log)
    lines = log.read_text().replace(f"{place}/", "").splitlines()
    return [line.split(" ", 1) for line in lines]


def cases_of(situation: Situation, calls: list[list[str]]) -> list[Case]:
    """Returns all faults of a situation: each call once with each error, and lasting ones."""
    count: collections.Counter[str] = collections.Counter()
    cases = []
    for kind, path in calls:
        count[kind] += 1
        for error in ERRORS[kind]:
            group = (situation.name, error, kind, place_of(path))
            cases.append(Case(situation, Fault((kind,), count[kind], error), group))
    for error, kinds in LASTING.items():
        met = sum(kind in kinds for kind, _ in calls)
        for nth in range(1, met + 1, LASTING_EVERY):
            fault = Fault(kinds, nth, error, once=False)
            cases.append(Case(situation, fault, (situation.name, error, "lasting")))
    return cases


def place_of(path: str) -> str:
    """Returns a path without what differs between checkpoints and between runs."""
    return re.sub(r"[0-9a-f]{12,}", "#", path)


def choose(cases: list[Case], every: int, sample: int, seed: int) -> list[Case]:
    """Returns some of the cases: of each group every so many, or a sample in which all groups are.

    Groups come in turn, those of lasting faults first, the others in an order drawn from the seed,
    until the sample is full.
    """
    groups: dict[tuple[str, ...], list[Case]] = {}
    for case in cases:
        groups.setdefault(case.group, []).append(case)
    if not sample:
        return [case for group in groups.values() for case in group[::every]]
    draw = random.Random(seed)
    mixed = [draw.sample(group, len(group)) for group in groups.values()]
    draw.shuffle(mixed)
    mixed.sort(key=lambda group: group[0].fault.once)
    rounds = itertools.chain.from_iterable(itertools.zip_longest(*mixed))
    return [case for case in rounds if case is not None][:sample]


def try_all(worker: Worker, whole: Whole, cases: list[Case], folder: Path, before: int) -> Found:
    """Makes each fault in a folder of its own; the stopped run is saved at update `before`."""
    met = told = 0
    failures: list[Failure] = []
    for number, case in enumerate(cases):
        place = prepare(case.situation, folder, f"case{number}")
        answer = ask(worker, whole.words, case.situation, place, fault=case.fault)
        met += bool(answer.fired) or answer.hung
        told += answer.code != SUCCESS
        least = before if case.situation.begun else 0
        wrong, said = judge(worker, answer, whole, least, place)
        if wrong:
            fired = answer.fired.replace(f"{place}/", "") or str(case.fault)
            if case.fault.once is False:
                fired += ", and all after it"
            if verdicts.kind_of(wrong) not in {verdicts.kind_of(f.wrong) for f in failures}:
                print(f"{case.situation.name}, {fired}: {wrong}\n{said}", flush=True)
            failures.append(Failure(case, fired, wrong, said))
        shutil.rmtree(place, ignore_errors=True)
        if number % 200 == 199:
            print(f"{number + 1} of {len(cases)}, {len(failures)} failures", flush=True)
    return Found(met, told, failures)


def judge(
    worker: Worker, answer: Answer, whole: Whole, before: int, place: Path
) -> tuple[str, str]:
    """Says how a disturbed command ended, and takes it to its end.

    Args:
      worker: carries the command out once more.
      answer: of the disturbed one.
      whole: the undisturbed run.
      before: the update that was saved before the disturbed command began.
      place: where the run is.

    Returns:
      what is wrong, "" if nothing is; and what was said.
    """
    least = saved_by(answer, whole, before)
    wrong = verdicts.complaint(answer, place, whole) if answer.code == SUCCESS else (
        verdicts.untold(answer)
    )  # fmt: skip
    if wrong:
        return wrong, answer.said + answer.stuck
    again = worker.run(command(whole.words, place), place)
    said = f"{answer.said}--- then, without the fault:\n{again.said}{again.stuck}"
    if wrong := verdicts.complaint(again, place, whole):
        return f"then: {wrong}", said
    began = verdicts.began_at(again, whole)
    if began < least:
        return f"then: it goes on after update {began}, and {least} was said to be saved", said
    return "", ""


def saved_by(answer: Answer, whole: Whole, before: int) -> int:
    """Returns the update that a command has said is saved, or that was saved `before` it."""
    if answer.code == SUCCESS:
        return verdicts.last(whole)
    stopped = re.search(r"Stopped after update (\d+) of \d+; it is saved", answer.err)
    return int(stopped[1]) if answer.code == INTERRUPTED and stopped else before


def ask(
    worker: Worker,
    words: list[str],
    situation: Situation,
    place: Path,
    trace: Path | None = None,
    fault: Fault | None = None,
) -> Answer:
    """Carries the run command out in a situation."""
    return worker.run(
        command(words, place), place, trace=trace, fault=fault, stop_at=situation.stop_at,
        armed_at_stop=situation.stop_at is not None,
    )  # fmt: skip


def prepare(situation: Situation, folder: Path, name: str) -> Path:
    """Returns a new folder, with the stopped run in it if the situation is a resume."""
    place = fresh(folder / name)
    if situation.begun:
        shutil.copytree(folder / "stopped", place, dirs_exist_ok=True)
    return place


def _print_table(found: Found) -> None:
    """Prints how many faults failed in which way, by situation, and the calls that were met."""
    names = [situation.name for situation in SITUATIONS]
    kinds: dict[str, list[Failure]] = {}
    for failure in found.failures:
        kinds.setdefault(verdicts.kind_of(failure.wrong), []).append(failure)
    print("".join(f"{name:>8}" for name in names), " failure")
    for kind, failures in sorted(kinds.items(), key=lambda item: -len(item[1])):
        by_name = collections.Counter(failure.case.situation.name for failure in failures)
        print("".join(f"{by_name[name]:8}" for name in names), f" {kind}")
        met = collections.Counter(place_of(failure.met) for failure in failures)
        for call, number in met.most_common(5):
            print(" " * 8 * len(names), f"   {number} x {call}")


if __name__ == "__main__":
    sys.exit(main())
