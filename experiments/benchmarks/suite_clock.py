"""Returns on the control suite by the clock: what a task has reached after so many seconds.

`suite_reference_time.csv` beside this file has what others reached by then: interquartile means
from the curves over time that REPPO's authors published (February 2026; REPPO with 1,024
environments x 128 steps, brax's PPO and SAC), on a GPU that is not named there. Ours count from the
beginning of the command, so importing and compiling are in them.
"""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from purerl.experiments.benchmarks.suite_scores import Seed, parted, told
from purerl.report import bootstrap

REFERENCES = Path(__file__).parent / "suite_reference_time.csv"
TIMES = (126, 316, 632, 1200)  # [s]
Published = dict[str, dict[str, list[float | None]]]  # task -> who -> return at each of TIMES


def references(path: Path = REFERENCES) -> Published:
    """Returns what others reached; None where they published nothing."""
    found: Published = {}
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            cells = [row[str(second)] for second in TIMES]
            found.setdefault(row["task"], {})[row["who"]] = [float(x) if x else None for x in cells]
    return found


def names(published: Published) -> list[str]:
    """Returns who published, in the order of the file."""
    return list(dict.fromkeys(who for one in published.values() for who in one))


def scores(seeds: Sequence[Seed]) -> list[np.ndarray]:
    """Returns the returns [n] of the seeds at each of TIMES."""
    return [np.array([s.score_at(second) for s in seeds]) for second in TIMES]


def table(tasks: dict[str, list[Seed]], published: Published) -> list[list[Any]]:
    """Returns the rows of returns by the clock, the head first.

    A row has the machine, the mean seconds to the first line of metrics (which tell a start from
    cold), IQM and lowest seed at each time, and what others had then. A run that ended earlier
    keeps its last return.
    """
    who = names(published)
    head = [f"{name}_{second}" for name in ("purerl", "lowest", *who) for second in TIMES]
    rows: list[list[Any]] = [["task", "n", "machine", "start", *head]]
    for task, seeds in tasks.items():
        returns = scores(seeds)
        starts = [s.start for s in seeds if s.start is not None]
        theirs = [published.get(task, {}).get(name, [None] * len(TIMES)) for name in who]
        rows.append(
            [
                task,
                len(seeds),
                " and ".join(sorted({s.machine for s in seeds} - {""})),
                round(float(np.mean(starts)), 1) if starts else "",
                *(round(float(bootstrap.interquartile_mean(x)), 1) for x in returns),
                *(round(float(x.min()), 1) for x in returns),
                *("" if x is None else x for values in theirs for x in values),
            ]
        )
    return rows


def verdicts(tasks: dict[str, list[Seed]], published: Published) -> Iterator[str]:
    """Yields a line for each of the others and each time: how many tasks are at or above them."""
    for name in names(published):
        for i, second in enumerate(TIMES):
            found = {task: rows[name][i] for task, rows in published.items() if name in rows}
            theirs = {task: value for task, value in found.items() if value is not None}
            ours = {task: scores(seeds)[i] for task, seeds in tasks.items()}
            if ours.keys() & theirs.keys():
                yield told(f"{name} after {second} s", *parted(ours, theirs))
