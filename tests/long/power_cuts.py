"""Cuts the power after every change that a short run makes to its files, and resumes what is left.

python -m tests.long.power_cuts [--every 10] [--models strict,names] [-- EXPERIMENT [--option 1]]

Records the calls of a run that is stopped in between and resumed (`tests/faults/shim.c`). For a cut
after each of its changes, `tests/faults/disk.py` tells which files a power cut may leave: only what
fsync has promised (strict), all names but only promised bytes (names), with half of the other bytes
(torn) or zeros (zeros), everything (written). Each such folder is resumed, or begun anew where
there is none. It must end with the digest and the metrics.jsonl (the clock aside) of a run that
nobody disturbed, set no checkpoint aside, and not go back: neither behind what the run had said
(that it is saved, that it is done), nor behind what an earlier cut left. Exit code 0 if all do.
"""

import argparse
import collections
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from purerl.core.errors import INTERRUPTED, SUCCESS
from tests.faults import disk
from tests.faults.commands import Worker, fresh, workplace
from tests.faults.verdicts import (
    SHORT,
    STOP_AT,
    Whole,
    began_at,
    command,
    complaint,
    kind_of,
    last,
    saved,
    undisturbed,
)

INSIDE = re.compile(r"/checkpoints/[^/]+/")  # what is in a checkpoint, finished or not


class Recorded(NamedTuple):
    """What a run did to its files."""

    changes: list[disk.Change]
    promises: list[tuple[int, int]]  # after so many changes it had said that this update is saved


class Ended(NamedTuple):
    """How what a cut had left was taken to its end."""

    wrong: str  # "" if nothing is
    began: int  # the update after which it went on
    said: str


class Failure(NamedTuple):
    """A cut that a run does not survive."""

    cut: int
    model: str
    change: str  # the last one before the cut
    wrong: str
    said: str


class Found(NamedTuple):
    """What came of all cuts."""

    cuts: int
    trees: int
    failures: list[Failure]


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the check; returns its exit code."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "tests.long.power_cuts", description=__doc__, formatter_class=plain
    )
    parser.add_argument(
        "--every",
        type=int,
        default=1,
        help="of so many changes inside of a checkpoint, one is followed by a cut",
    )
    parser.add_argument("--models", default=",".join(disk.MODELS), help="what a cut leaves")
    parser.add_argument("words", nargs="*", help="-- EXPERIMENT [--option value ...]")
    options = parser.parse_args(arguments)
    models = tuple(options.models.split(","))
    if strange := set(models) - set(disk.MODELS):
        parser.error(f"there is no model {min(strange)}; there are: {', '.join(disk.MODELS)}")
    found = cut_all(options.words or SHORT, options.every, models)
    return 1 if found.failures else 0


def cut_all(words: list[str], every: int, models: tuple[str, ...]) -> Found:
    """Makes all cuts, and prints what came of them."""
    begin = time.monotonic()
    with workplace() as (folder, worker):
        whole = undisturbed(worker, words, fresh(folder / "whole"))
        recorded = record(worker, words, folder)
        changes = recorded.changes
        print(f"a run of {last(whole)} updates, stopped and resumed: "
              f"{len(changes)} changes of files", flush=True)  # fmt: skip
        found = try_all(worker, whole, recorded, folder, cuts_after(changes, every), models)
    _print_table(found, models)
    print(f"{found.cuts} cuts, {len(models)} models, {found.trees} different folders: "
          f"{len(found.failures)} failures; {time.monotonic() - begin:.0f} s")  # fmt: skip
    return found


def cuts_after(changes: list[disk.Change], every: int) -> set[int]:
    """Returns after how many changes there is a cut.

    Args:
      changes: a record.
      every: of so many changes inside of a checkpoint, one is followed by a cut; all others are.
    """
    numbered = enumerate(changes, 1)
    beside = {number for number, change in numbered if not INSIDE.search(change.path)}
    return beside | {0, len(changes)} | set(range(0, len(changes), every))


def record(worker: Worker, words: list[str], folder: Path) -> Recorded:
    """Makes a run that is stopped and resumed; RuntimeError if a change of its files was missed."""
    place, log = fresh(folder / "recorded"), folder / "own" / "record"
    promises = []
    for stop_at, code in ((STOP_AT, INTERRUPTED), (None, SUCCESS)):
        answer = worker.run(command(words, place), place, record=log, stop_at=stop_at)
        if answer.code != code:
            raise RuntimeError(f"The recorded run ended with {answer.code}:\n{answer.said}")
        promises.append((len(disk.read_record(log)), saved(place)))
    changes, model = disk.read_record(log), disk.Disk(place)
    for change in changes:
        model.apply(change)
    if model.tree("written") != disk.read_tree(place):
        raise RuntimeError("The record is not what the disk holds: some call was missed.")
    return Recorded(changes, promises)


def try_all(
    worker: Worker,
    whole: Whole,
    recorded: Recorded,
    folder: Path,
    cuts: set[int],
    models: tuple[str, ...],
) -> Found:
    """Resumes what each cut leaves; what was left before is not resumed again."""
    root, changes = folder / "recorded", recorded.changes
    known: dict[tuple, Ended] = {}
    furthest = dict.fromkeys(models, 0)
    failures: list[Failure] = []
    for cut, model, tree in disk.trees(disk.Disk(root), changes, cuts, models):
        key = tuple(sorted(tree.items()))
        if key not in known:
            known[key] = resume(worker, whole, tree, fresh(folder / "cut"))
        ended = known[key]
        wrong = ended.wrong
        promised = max((update for after, update in recorded.promises if after <= cut), default=0)
        least = max(furthest[model], promised)
        if not wrong and ended.began < least:
            why = "the run had said" if promised == least else "an earlier cut left"
            wrong = f"it goes on after update {ended.began}, and {why} that {least} is saved"
        furthest[model] = least if ended.wrong else max(ended.began, least)
        if wrong:
            change = str(changes[cut - 1]).replace(f"{root}/", "") if cut else "nothing"
            if kind_of(wrong) not in {kind_of(failure.wrong) for failure in failures}:
                print(f"cut {cut} ({model}), after {change}: {wrong}\n{ended.said}", flush=True)
            failures.append(Failure(cut, model, change, wrong, ended.said))
    return Found(len(cuts), len(known), failures)


def resume(worker: Worker, whole: Whole, tree: disk.Tree, place: Path) -> Ended:
    """Takes what a cut has left to its end."""
    disk.write_tree(tree, place)
    answer = worker.run(command(whole.words, place), place)
    return Ended(complaint(answer, place, whole), began_at(answer, whole), answer.said)


def _print_table(found: Found, models: tuple[str, ...]) -> None:
    """Prints how many cuts failed in which way, by model, and the first of each."""
    counts: dict[str, collections.Counter] = {}
    for failure in found.failures:
        counts.setdefault(kind_of(failure.wrong), collections.Counter())[failure.model] += 1
    print("".join(f"{model:>9}" for model in models), " failure")
    for kind, by_model in sorted(counts.items(), key=lambda item: -item[1].total()):
        print("".join(f"{by_model[model]:9}" for model in models), f" {kind}")
        first = next(f for f in found.failures if kind_of(f.wrong) == kind)
        print(" " * 9 * len(models), f"   the first: cut {first.cut} ({first.model}), "
              f"after {first.change}")  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
