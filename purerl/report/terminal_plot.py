"""Curves in a terminal, by plain characters."""

from collections.abc import Iterable, Sequence
from itertools import cycle

from purerl.core.errors import UserError
from purerl.report import page_charts, run_reader
from purerl.report.page_series import visible
from purerl.report.seed_statistics import Curve, check_metric

MARKS = "*ox+#@%&"
LEAST_COLUMNS, LEAST_ROWS = 20, 6  # of the field
LABEL = 10  # columns left of the field


def check_plotted(runs: Sequence[run_reader.RunRecord], metric: str) -> None:
    """Raises UserError unless a run has a value of the metric that can be drawn."""
    check_metric(runs, metric)
    if not any(visible(run.curve(metric)) for run in runs):
        raise UserError(f"{metric} has no finite value in these runs; choose another --metric.")


def draw(curves: Sequence[Curve], metric: str, columns: int, rows: int) -> list[str]:
    """Returns curves against control steps as lines of text, a mark for each group.

    Args:
      curves: one for each group, with its runs.
      metric: its name, which stands above.
      columns: of the terminal.
      rows: of the field.
    """
    columns, rows = max(columns - LABEL - 1, LEAST_COLUMNS), max(rows, LEAST_ROWS)
    points = [[(s, v) for run in curve.runs for s, v in visible(run).items()] for curve in curves]
    every = [point for each in points for point in each]
    low, high = page_charts.extent([value for _, value in every])
    last = max(steps for steps, _ in every) or 1
    field = [[" "] * columns for _ in range(rows)]
    for curve, mark in zip(curves, cycle(MARKS), strict=False):
        for run in curve.runs:
            for x, share in _columns(visible(run), last, columns, low, high):
                field[rows - 1 - round(share * (rows - 1))][x] = mark
    every_fourth = {0, rows - 1} | set(range(0, rows, max(rows // 4, 1)))
    lines = [metric]
    for i, row in enumerate(field):
        label = page_charts.short(high - (high - low) * i / (rows - 1)) if i in every_fourth else ""
        lines.append(f"{label[:LABEL]:>{LABEL}}|{''.join(row)}".rstrip())
    lines.append(f"{'':{LABEL}}+{'-' * columns}")
    end = f"{page_charts.short(last)} steps"
    lines.append(f"{'':{LABEL}} 0{end:>{columns - 1}}")
    legend = zip(curves, cycle(MARKS), strict=False)
    return lines + [f"  {mark}  {c.label} (n = {len(c.runs)})" for c, mark in legend]


def _columns(
    run: dict[int, float], last: int, columns: int, low: float, high: float
) -> Iterable[tuple[int, float]]:
    """Returns for each column that a run passes the share of the height at which it does."""
    known = sorted((s * (columns - 1) / last, (v - low) / (high - low)) for s, v in run.items())
    for (x, y), (x_next, y_next) in zip(known, known[1:], strict=False):
        for column in range(round(x), round(x_next)):
            yield column, y + (y_next - y) * max(0.0, column - x) / (x_next - x)
    for x, y in known[-1:]:
        yield round(x), y
