"""What came of a sweep: a row for each point, best first, as text, as CSV and as a picture."""

import contextlib
import numbers
from collections.abc import Container, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from purerl.core.errors import UserError
from purerl.machine import files, output
from purerl.report import comparison, run_reader
from purerl.report.seed_statistics import Group, summarize
from purerl.tune.sweep.points import Base, Point, job, typed_values
from purerl.tune.sweep.scheduler import how_it_ended, is_locked
from purerl.tune.sweep.spaces import Space

# A score of a part of the seeds, or of a part of the training, comes after whole ones.
ORDER = ("done", "training", "stopped", "waiting", "failed")
COLUMNS = 3  # of the picture
SPREAD = 10.0  # of listed values, largest / smallest, from which their axis is logarithmic


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
        with contextlib.suppress(UserError):  # not begun
            runs.append(run_reader.read(folder))
    return Group(point.name, runs, {"": runs})


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
    found = {name: row.summary[name] for name in ("n", "score", "mean", "worst")}
    found |= row.summary["interval"] or {}
    about = {"status": row.status, "said": row.said}
    return {"point": row.point.name} | row.point.values | found | about


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
    found = (row.summary for row in rows)
    return lines + comparison.notes([s for s in found if s["done"] + s["failed"] + s["unfinished"]])


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
    folder: Path, rows: Sequence[Row], spaces: Sequence[Space], metric: str, lines: Sequence[str]
) -> list[Path]:
    """Writes sweep.csv, sweep.txt and, if a point has a score, sweep.png; returns them."""
    sheet, text, drawn = (folder / f"sweep.{kind}" for kind in ("csv", "txt", "png"))
    names = ["point", *(space.setting for space in spaces)]
    names += ["n", "score", "low", "high", "mean", "worst", "status", "said"]
    files.write_file(sheet, files.as_csv(names, map(as_record, rows)))
    files.write_file(text, "".join(f"{output.printable(line)}\n" for line in lines).encode())
    return [sheet, text, *([drawn] if draw(drawn, rows, spaces, metric) else [])]


# --- the picture: the score over each swept setting ---


def has_log_axis(space: Space, values: Sequence[Any]) -> bool:
    """Tells whether a setting is shown on a logarithmic axis."""
    if not space.choices:
        return space.log
    return all(map(is_number, values)) and min(values) > 0 and max(values) >= SPREAD * min(values)


def draw(path: Path, rows: Sequence[Row], spaces: Sequence[Space], metric: str) -> bool:
    """Writes the picture; returns False, and writes none, if no point has a score.

    Args:
      path: the PNG.
      rows: the points, the best one first.
      spaces: the swept settings, each a panel.
      metric: the score's name.
    """
    rows = [row for row in rows if row.summary["score"] is not None]
    if not rows:
        return False
    columns = min(COLUMNS, len(spaces))
    lines = -(-len(spaces) // columns)
    size = (4.5 * columns + 1, 3.6 * lines)
    drawn = comparison.picture(path, lines, columns, figsize=size, sharey=True, squeeze=False)
    with drawn as (figure, axes):
        for panel, space in zip(axes.flat, spaces, strict=False):
            _draw_panel(panel, rows, space)
        for panel in axes.flat[len(spaces) :]:
            panel.set_axis_off()
        for panel in axes[:, 0]:
            panel.set_ylabel(output.printable(metric))
        legends = (panel.get_legend_handles_labels() for panel in axes.flat)
        handles = max(legends, key=lambda legend: len(legend[0]))
        figure.legend(*handles, loc="outside lower center", ncols=4, fontsize="small")
    return True


def _draw_panel(panel: Any, rows: Sequence[Row], space: Space) -> None:
    """Draws a point's seeds, its score and interval; the line joins the medians of each value."""
    values = [row.typed[space.setting] for row in rows]
    names = sorted({str(value): value for value in values}.values(), key=by_value)
    numbers = all(map(is_number, values))
    place = [float(v) if numbers else float(names.index(v)) for v in values]
    scores = [row.summary["score"] for row in rows]
    both = list(zip(place, rows, strict=True))
    seeds = [(x, y) for x, row in both for y in row.summary["runs"].values()]
    panel.plot(*zip(*seeds, strict=True), ".", color="0.7", markersize=4, label="one seed")
    for x, row in both:
        if row.summary["interval"]:
            ends = row.summary["interval"]
            panel.plot([x, x], [ends["low"], ends["high"]], color="C0", linewidth=1.5, alpha=0.5)
    panel.plot(place, scores, "o", color="C0", markersize=6, label="score of a point, 95% interval")
    if rows[0].status == "done":
        panel.plot(place[0], scores[0], "o", color="C1", markersize=9, label="best point")
    different = sorted(set(place))
    if space.choices and len(different) < len(place):
        medians = [np.median([y for x, y in zip(place, scores, strict=True) if x == one])
                   for one in different]  # fmt: skip
        panel.plot(different, medians, color="C0", linewidth=1, label="median of the points")
    panel.set_xlabel(output.printable(space.setting))
    panel.grid(alpha=0.3)
    if numbers and has_log_axis(space, values):
        panel.set_xscale("log")
        # Matplotlib's own labels of decades need its mathematics.
        panel.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
        panel.xaxis.set_minor_formatter(lambda x, _: "")
    if not numbers or (space.choices and len(names) <= 8):  # the values themselves, no others
        panel.set_xticks(different, [_label(name) for name in names])
        panel.minorticks_off()


def _label(value: Any) -> str:
    if isinstance(value, tuple | list):
        return " ".join(map(_label, value))
    return f"{value:.4g}" if isinstance(value, float) else output.printable(str(value))[:24]
