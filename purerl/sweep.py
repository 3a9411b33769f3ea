"""Trains an experiment with many settings: `python -m purerl.sweep EXPERIMENT --grid NAME=1,2`.

A sweep's folder has the runs, a log of each, and what came of them: sweep.csv, sweep.txt and
sweep.png. The same command goes on with a sweep that was stopped.
"""

import contextlib
from collections.abc import Sequence

from purerl.experiment import command_line
from purerl.machine.command_errors import leave
from purerl.tune.sweep.options import PROG, SweepOptions


def show_help(words: Sequence[str]) -> None:
    """Prints the help page."""
    with contextlib.suppress(SystemExit):
        command_line.parse(SweepOptions, ["--help"], PROG)


def command(words: Sequence[str]) -> int:
    """Carries the sweep out; returns the exit code."""
    from purerl.tune.sweep.session import execute

    return execute(words)


main = command_line.main_of_words(command, show_help)


if __name__ == "__main__":
    leave(main)
