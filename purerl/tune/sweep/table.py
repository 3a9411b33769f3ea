"""What came of a sweep: a row for each point, best first, as text and as CSV."""

import numbers
from collections.abc import Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import UserError
from purerl.machine.files import writing
from purerl.report import comparison, run_reader
from purerl.report.seed_statistics import Group, check_scored, summarize
from purerl.tune.sweep.points import Base, Point, job, typed_values
from purerl.tune.sweep.scheduler import how_it_ended, is_locked
from purerl.tune.sweep.spaces import Space

# A score of a part of the seeds, or of a part of the training, comes after whole ones.
ORDER = ("done", "training", "stopped", "waiting", "failed")


class Row(NamedTuple):
    """One point, and what it scored."""

    point: Point
    typed: dict[str, Any]  # setting -> value
    status: str  # of ORDER
    said: str  # the last line of a point that failed
    summary: dict[str, Any]  # of `seed_statistics.summarize`


def make_rows(
    base: Base, points: Sequence[Point], metric: str, queued: Container[str] = ()
) -> list[Row]:
    """Returns a row for each point, best first; numbers stand in the order of numbers.

    Those of the names `queued` wait to be trained, or begin: what was stopped goes on by itself.
    """
    rows = []
    for point, typed in zip(points, typed_values(base, points), strict=True):
        one = job(base, point)
        found = how_it_ended(one)
        status = found.status
        if status != "done" and is_locked(one):
            status = "training"
        elif status == "stopped" and (one.name in queued or not one.log.exists()):
            status = "waiting"
        summary = summarize(group_of(base, point), metric)
        rows.append(Row(point, typed, status, found.said, summary))
    return sorted(rows, key=_rank)


def group_of(base: Base, point: Point) -> Group:
    """Returns the runs of a point that can be read, as `compare` groups runs."""
    runs = []
    for folder in job(base, point).folders:
        try:
            runs.append(run_reader.read(folder))
        except UserError:  # not begun
            continue
    return Group(point.name, runs, {"": runs})


def check_metric(base: Base, points: Iterable[Point], metric: str) -> None:
    """Raises UserError, with the nearest name, if no run of these points has such a metric."""
    runs = [run for point in points for run in group_of(base, point).runs]
    if not any(metric in line for run in runs for line in run.lines):
        check_scored(runs, [], metric)


def _rank(row: Row) -> tuple[Any, ...]:
    score = row.summary["score"]
    place = ORDER.index(row.status) if score is not None else len(ORDER)
    return (place, -(score or 0.0), *map(by_value, row.typed.values()), row.point.number)


def by_value(value: Any) -> tuple[int, tuple[float, ...], str]:
    """Returns a key that sorts numbers as numbers, then rows of them, then others as text.

    >>> sorted([10, (16, 8), (8, 16), 9, "a", 8.5], key=by_value)
    [8.5, 9, 10, (8, 16), (16, 8), 'a']
    """
    if is_number(value):
        return 0, (float(value),), ""
    if isinstance(value, tuple | list) and all(map(is_number, value)):
        return 1, tuple(map(float, value)), ""
    return 2, (), str(value)


def is_number(value: Any) -> bool:
    """Tells whether a setting's value is a number; true and false are none."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def as_record(row: Row) -> dict[str, Any]:
    """Returns a row as columns."""
    interval = row.summary["interval"] or {"low": None, "high": None}
    names = ("n", "score", "mean", "worst")
    return {
        "point": row.point.name,
        **row.point.values,
        **{name: row.summary[name] for name in names},
        **interval,
        "status": row.status,
        "said": row.said,
    }


def describe(rows: Sequence[Row], spaces: Sequence[Space], metric: str) -> list[str]:
    """Returns the table as lines of text, then why points failed."""
    columns = [("point", "point"), *((space.setting, space.setting) for space in spaces)]
    columns += [("n", "n"), ("score", "score"), ("95% interval", "interval"), ("worst", "worst")]
    columns += [("status", "status")]
    records = [as_record(row) | {"interval": row.summary["interval"]} for row in rows]
    for record in records:
        record |= {space.setting: _shown(record[space.setting]) for space in spaces}
    counts = {status: sum(row.status == status for row in rows) for status in ORDER}
    told = ", ".join(f"{number} {status}" for status, number in counts.items() if number)
    lines = [f"{len(rows)} point{'s' * (len(rows) > 1)} ({told}), {metric} at the end"]
    lines += comparison.table(columns, records)
    lines += [f"{row.point.name} failed: {row.said}" for row in rows if row.status == "failed"]
    return lines + comparison.notes([row.summary for row in rows if _has_runs(row)])


def _has_runs(row: Row) -> bool:
    return any(row.summary[name] for name in ("done", "failed", "unfinished"))


def _shown(text: str) -> str:
    """Returns a value as it was given, many digits as four.

    >>> _shown("3e-4"), _shown("0.000123456789"), _shown("100000000"), _shown("64 64")
    ('3e-4', '0.0001235', '100000000', '64 64')
    """
    try:
        return f"{float(text):.4g}" if "." in text and len(text) > 7 else text
    except ValueError:
        return text


def write(
    folder: Path, rows: Sequence[Row], spaces: Sequence[Space], lines: Sequence[str]
) -> Mapping[str, Path]:
    """Writes sweep.csv and sweep.txt; returns them by their kind."""
    files = {kind: folder / f"sweep.{kind}" for kind in ("csv", "txt")}
    names = ["point", *(space.setting for space in spaces)]
    names += ["n", "score", "low", "high", "mean", "worst", "status", "said"]
    with writing(folder):
        comparison.write_csv(files["csv"], names, map(as_record, rows))
        files["txt"].write_text("\n".join(lines) + "\n", errors="backslashreplace")
    return files
