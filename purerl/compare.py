"""Compares runs: `python -m purerl.compare RUN RUN ... [--metric eval/episode_return] [--out DIR]`.

Runs of one configuration and seed: the same to the last bit, or where they part. Runs of several
seeds: interquartile means with 95% intervals, the probability that one configuration beats another,
differences on the same seeds, learning curves.

Exit codes: 0 compared; 1 two runs that promise the same bits have not; 2 a mistake in the command.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from purerl.core.errors import FAILURE, SUCCESS
from purerl.experiment.command_line import main_of
from purerl.machine import command_errors, output


@dataclass(frozen=True)
class CompareOptions:
    """Compares runs: bit by bit where configuration and seed agree, else by statistics over seeds.

    Ten seeds against ten others: python -m purerl.compare 'runs/ant_run/a*' 'runs/ant_run/b*'
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Runs, folders of runs (runs/ant_run), or patterns ('runs/ant_run/wide*'). The group of the
    first one is what the others are compared with."""
    metric: str = "eval/episode_return"
    """What to compare; a run's score is its last value."""
    group_by: tuple[str, ...] = ()
    """Settings that make a group, such as ppo.learning_rate or experiment; by default all in which
    the runs differ, but the seed."""
    out: Path | None = None
    """Folder for compare.json, groups.csv, curves.csv and curves.png."""


def command(options: CompareOptions) -> int:
    """Compares, prints and writes what was asked for; returns the exit code."""
    from purerl.report import comparison

    result, curves = comparison.compare(options.runs, options.metric, options.group_by)
    output.show(*comparison.describe(result))
    if options.out is not None:
        comparison.write(options.out, result, curves)
    broken = any(pair["same"] is False and pair["promised"] for pair in result["pairs"])
    return FAILURE if broken else SUCCESS


main = main_of(CompareOptions, command, "python -m purerl.compare")


if __name__ == "__main__":
    command_errors.leave(main)
