"""What runs on the control suite scored: a row for each seed, a table of tasks, pictures.

`suite_reference.csv` beside this file has what others published: interquartile means of 1000 on
MuJoCo Playground's version of each task, computed from the per-seed curves that REPPO's authors
published (February 2026), and TD-MPC2's published means after 4 M steps on dm_control's own. brax's
PPO trained for 79 to 184 M steps, SAC for 5 to 26 M, REPPO for 200 M.
"""

import csv
import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from purerl.core.errors import UserError
from purerl.report import bootstrap
from purerl.report.run_reader import RunRecord

METRIC = "eval/episode_return"
BEST = 1000.0  # the greatest return of an episode of 1000 steps
REFERENCES = Path(__file__).parent / "suite_reference.csv"
COLUMNS = ("task", "seed", "status", "steps", "return", "seconds")  # of seeds.csv
MORE = ("start", "machine")  # of seeds.csv too, if it is of this version
SHOWN = ("brax_ppo_10M", "brax_ppo_end", "reppo_end", "tdmpc2_4M")  # columns of the table
LEVELS = np.linspace(0.0, BEST, 101)


class Seed(NamedTuple):
    """One seed of one task."""

    task: str
    seed: int
    status: str  # "done", "failed" or "unfinished"
    steps: tuple[int, ...]  # of each evaluation
    returns: tuple[float, ...]  # of each evaluation
    seconds: tuple[float, ...]  # since its command began, at each evaluation
    start: float | None = None  # [s] until its first line of metrics; compiling is most of it
    machine: str = ""  # what it was trained on

    @property
    def score(self) -> float:
        """The last return. A run that failed before its first evaluation has learned nothing: 0."""
        return self.returns[-1] if self.returns else 0.0

    def score_at(self, second: float) -> float:
        """Returns what the newest evaluation by then returned; 0 before the first."""
        return next(
            (r for r, s in zip(self.returns[::-1], self.seconds[::-1], strict=True) if s <= second),
            0.0,
        )


def seed_of(run: RunRecord) -> Seed:
    """Returns what a run on a task scored."""
    start = next((line["wall_s"] for line in run.lines if "wall_s" in line), None)
    machine = str(run.manifest.get("device", {}).get("kind", ""))
    return Seed(run.settings["env.task"], run.seed, run.status, *evaluations(run), start, machine)


def evaluations(run: RunRecord) -> tuple[tuple[int, ...], tuple[float, ...], tuple[float, ...]]:
    """Returns steps, return and seconds since its command began, at each evaluation of a run."""
    lines = [line for line in run.lines if line.get(METRIC) is not None]
    return (
        tuple(line["steps"] for line in lines),
        tuple(float(line[METRIC]) for line in lines),
        tuple(float(line.get("wall_s") or 0.0) for line in lines),
    )


# --- files ---


def write_seeds(path: Path, seeds: Iterable[Seed]) -> None:
    """Writes a row for each evaluation of each seed; a seed without one has a row too."""
    with path.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(COLUMNS + MORE)
        for s in seeds:
            name, more = (s.task, s.seed, s.status), ("" if s.start is None else s.start, s.machine)
            if not s.steps:
                rows.writerow([*name, "", "", "", *more])
            for steps, value, seconds in zip(s.steps, s.returns, s.seconds, strict=True):
                rows.writerow([*name, steps, f"{value:.2f}", f"{seconds:.1f}", *more])


def read_seeds(path: Path) -> list[Seed]:
    """Reads what `write_seeds` wrote: the table and the pictures can be made of the file alone.

    Raises:
      UserError: the file is no text, lacks a column, or has words where numbers belong.
    """
    kind = (
        f"a file of scores is the seeds.csv of this command, with the columns {', '.join(COLUMNS)}."
    )
    with path.open(newline="") as file:
        rows = csv.DictReader(file)
        try:
            if missing := [name for name in COLUMNS if name not in (rows.fieldnames or ())]:
                raise UserError(f"{path} has no column {', '.join(missing)}; {kind}")
            return _seeds_of(rows)
        except (TypeError, ValueError) as error:  # TypeError: a line that ends early
            raise UserError(f"{path}, line {rows.line_num}: {error}; {kind}") from None


def _seeds_of(rows: Iterable[dict[str, str]]) -> list[Seed]:
    """Returns the seeds whose evaluations `rows` are."""
    found: dict[tuple[str, int, str], Seed] = {}
    for row in rows:
        name = row["task"], int(row["seed"]), row["status"]
        start = float(row["start"]) if row.get("start") else None
        s = found.setdefault(name, Seed(*name, (), (), (), start, row.get("machine") or ""))
        if row["steps"]:
            found[name] = s._replace(
                steps=(*s.steps, int(row["steps"])),
                returns=(*s.returns, float(row["return"])),
                seconds=(*s.seconds, float(row["seconds"])),
            )
    return list(found.values())


def merged(sources: Iterable[Iterable[Seed]]) -> list[Seed]:
    """Returns each seed of a task once, from several sources: of one that two have, the longer.

    One that is unfinished does not count, so it gives way to any other.
    """

    def rank(s: Seed) -> tuple[bool, tuple[int, ...]]:
        return s.status != "unfinished", s.steps[-1:]

    found: dict[tuple[str, int], Seed] = {}
    for s in itertools.chain.from_iterable(sources):
        name = (s.task, s.seed)
        if name not in found or rank(s) > rank(found[name]):
            found[name] = s
    return sorted(found.values())


def references(path: Path = REFERENCES) -> dict[str, dict[str, float]]:
    """Returns task -> column -> return of what others published, where they have."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {row.pop("task"): {k: float(v) for k, v in row.items() if v} for row in rows}


# --- scores ---


def by_task(seeds: Iterable[Seed]) -> dict[str, list[Seed]]:
    """Returns task -> its seeds that count: done, or failed. One that is unfinished does not."""
    found: dict[str, list[Seed]] = {}
    for s in sorted(seeds):
        if s.status != "unfinished":
            found.setdefault(s.task, []).append(s)
    return found


def strata(tasks: dict[str, list[Seed]]) -> list[np.ndarray]:
    """Returns the scores of each task, [n] each."""
    return [np.array([s.score for s in seeds]) for seeds in tasks.values()]


def table(tasks: dict[str, list[Seed]], published: dict[str, dict[str, float]]) -> list[list[Any]]:
    """Returns the rows of the table of tasks, the head first.

    A row has IQM with its interval, the lowest seed, and what others published.
    """
    rows: list[list[Any]] = [
        ["task", "n", "failed", "steps", "iqm", "low", "high", "lowest", "seconds", *SHOWN]
    ]
    for task, seeds in tasks.items():
        scores = np.array([s.score for s in seeds])
        interval = bootstrap.iqm_interval([scores])
        rows.append(
            [
                task,
                len(seeds),
                sum(s.status == "failed" for s in seeds),
                max((s.steps[-1] for s in seeds if s.steps), default=0),
                round(float(bootstrap.interquartile_mean(scores)), 1),
                *([round(x, 1) for x in interval] if interval else ["", ""]),
                round(float(scores.min()), 1),
                round(max((s.seconds[-1] for s in seeds if s.seconds), default=0.0)),
                *(published.get(task, {}).get(column, "") for column in SHOWN),
            ]
        )
    return rows


def ahead(
    tasks: dict[str, list[Seed]], published: dict[str, dict[str, float]], column: str
) -> tuple[list[str], list[str]]:
    """Returns the tasks whose IQM is at or above a published column, and those that fall short."""
    scores = dict(zip(tasks, strata(tasks), strict=True))
    return parted(scores, {t: row[column] for t, row in published.items() if column in row})


def parted(
    scores: Mapping[str, np.ndarray], published: Mapping[str, float]
) -> tuple[list[str], list[str]]:
    """Returns which published tasks have an IQM of their scores [n] at or above it, and the others.

    What was published is whole numbers, so the IQM is rounded for this too: 999.7 is no less than
    a 1000 that may be 999.6.
    """
    above: list[str] = []
    below: list[str] = []
    for task in scores.keys() & published.keys():
        reached = np.rint(bootstrap.interquartile_mean(scores[task])) >= published[task]
        (above if reached else below).append(task)
    return sorted(above), sorted(below)


def told(what: str, above: Sequence[str], below: Sequence[str]) -> str:
    """Returns a line of what `parted` returned."""
    short = f"; short: {', '.join(below)}" if below else ""
    return f"at or above {what}: {len(above)} of {len(above) + len(below)}{short}"


def common_curve(
    seeds: Sequence[Seed],
) -> tuple[list[int], bootstrap.Band, np.ndarray] | None:
    """Returns steps [P], band, mean seconds [P] where all seeds were evaluated; None: nowhere."""
    steps = sorted(set.intersection(*(set(s.steps) for s in seeds))) if seeds else []
    if not steps:
        return None
    at = [{n: i for i, n in enumerate(s.steps)} for s in seeds]
    values = np.array([[s.returns[i[n]] for n in steps] for s, i in zip(seeds, at, strict=True)])
    seconds = np.array([[s.seconds[i[n]] for n in steps] for s, i in zip(seeds, at, strict=True)])
    return steps, bootstrap.curve_band([values], number=500), seconds.mean(axis=0)


def profile(tasks: dict[str, list[Seed]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the performance profile at `LEVELS`, with its interval: [101] each.

    F(tau) = mean over tasks of the share of a task's seeds that score more than tau.
    Agarwal et al. 2021, arXiv:2108.13264, equation 1.
    """
    scores = strata(tasks)

    def shares(values: Sequence[np.ndarray]) -> np.ndarray:
        return np.mean([(v[..., None] > LEVELS).mean(axis=-2) for v in values], axis=0)

    low, high = np.percentile(shares(bootstrap.resample(scores, 0, 1000)), [2.5, 97.5], axis=0)
    return shares(scores), low, high
