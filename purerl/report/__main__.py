"""Makes a page about runs: `python -m purerl.report RUN ... [--out report.html]`.

One HTML file: curves, every metric, evaluations, settings, videos. It needs no network, and any
browser opens it; hover for values. Nothing of the runs is executed.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from purerl.core.errors import UserError
from purerl.experiment.command_line import main_of
from purerl.machine import command_errors, files, output


@dataclass(frozen=True)
class ReportOptions:
    """Makes one HTML file about runs: curves, every metric, evaluations, settings, videos."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Runs, folders of runs (runs/ant_run), or patterns ('runs/ant_run/wide*')."""
    out: Path = Path("report.html")
    """The file to write."""
    group_by: tuple[str, ...] = ()
    """Settings that make a group, such as ppo.learning_rate; by default all in which the runs
    differ, but the seed."""


def command(options: ReportOptions) -> None:
    """Writes the page, and prints where it is."""
    from purerl.report.page import make_page
    from purerl.report.run_reader import read_runs

    if options.out.is_dir():
        raise UserError(f"{options.out} is a folder: give a file, as --out report.html.")
    runs = read_runs(options.runs, "report")
    page = make_page(runs, options.group_by).encode()
    files.write_answer(options.out, page)
    number = f"{len(runs)} run{'s' * (len(runs) > 1)}"
    output.show(f"{options.out} ({number}, {len(page):,} bytes): open it in a browser")


main = main_of(ReportOptions, command, "python -m purerl.report")


if __name__ == "__main__":
    command_errors.leave(main)
