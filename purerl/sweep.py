"""Trains an experiment with many settings: `python -m purerl.sweep EXPERIMENT --grid NAME=1,2`.

A sweep's folder has the runs, a log of each, and what came of them: sweep.csv, sweep.txt and
sweep.png. The same command goes on with a sweep that was stopped.
"""

import contextlib
import sys
from collections.abc import Sequence

from purerl.core.errors import SUCCESS, USAGE, RunError, UserError
from purerl.experiment import command_line
from purerl.machine.command_errors import leave, tell
from purerl.tune.sweep.options import PROG, SweepOptions


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if not arguments or {"-h", "--help"} & set(arguments):
        with contextlib.suppress(SystemExit):
            command_line.parse(SweepOptions, ["--help"], PROG)
        return SUCCESS if arguments else USAGE
    try:
        from purerl.tune.sweep.session import execute

        return execute(arguments)
    except (UserError, RunError) as error:
        return tell(error)


if __name__ == "__main__":
    leave(main)
