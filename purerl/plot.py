"""Plots a metric of runs: `python -m purerl.plot RUN ... [--metric M] [--out F.png]`.

In the terminal, as wide as that is, by plain characters; with --out also as a picture.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from purerl.core.errors import UserError
from purerl.experiment.command_line import main_of
from purerl.machine import command_errors, output


@dataclass(frozen=True)
class PlotOptions:
    """Plots a metric of runs in the terminal, and as a picture."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Runs, folders of runs (runs/ant_run), or patterns ('runs/ant_run/wide*')."""
    metric: str = "eval/episode_return"
    """What to plot, against control steps."""
    out: Path | None = None
    """Also write a picture (.png, .pdf, .svg): groups as in compare, their IQMs, their runs."""


def command(options: PlotOptions) -> None:
    """Prints the curve, and writes the picture that was asked for."""
    from purerl.report import comparison
    from purerl.report.run_reader import read_runs
    from purerl.report.seed_statistics import every_curve, make_groups
    from purerl.report.terminal_plot import check_plotted, draw

    if options.out is not None and options.out.suffix not in (".png", ".pdf", ".svg"):
        raise UserError(f"out is {options.out}; it must end in .png, .pdf or .svg.")
    runs = read_runs(options.runs, "plot")
    groups = make_groups(runs, ())
    check_plotted(runs, options.metric)
    curves = [every_curve(group, options.metric) for group in groups]
    columns, rows = shutil.get_terminal_size((100, 30))
    output.show(*draw(curves, options.metric, columns, min(rows - 6, 24)))
    if options.out is not None:
        comparison.draw_curves(options.out, curves, options.metric)
        output.show(str(options.out))


main = main_of(PlotOptions, command, "python -m purerl.plot")


if __name__ == "__main__":
    command_errors.leave(main)
