"""A picture of a sweep: the score over each swept setting."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from purerl.machine.output import printable
from purerl.report.comparison import picture
from purerl.tune.sweep.spaces import Space
from purerl.tune.sweep.table import Row, by_value, is_number

COLUMNS = 3
SPREAD = 10.0  # of listed values, largest / smallest, from which their axis is logarithmic


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
    with picture(path, lines, columns, figsize=size, sharey=True, squeeze=False) as (figure, axes):
        for panel, space in zip(axes.flat, spaces, strict=False):
            _draw_panel(panel, rows, space)
        for panel in axes.flat[len(spaces) :]:
            panel.set_axis_off()
        for panel in axes[:, 0]:
            panel.set_ylabel(printable(metric))
        handles = max(
            (panel.get_legend_handles_labels() for panel in axes.flat), key=lambda x: len(x[0])
        )
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
    panel.set_xlabel(printable(space.setting))
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
    return f"{value:.4g}" if isinstance(value, float) else printable(str(value))[:24]
