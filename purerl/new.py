"""Writes a project of your own: `python -m purerl.new NAME`: environment, body, experiment, test.

The folder NAME needs no place in the clone. It trains at once, and its comments say what to change:

    python -m purerl.new my_robot
    cd my_robot
    python -m purerl.run experiment.py
"""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from purerl.experiment.command_line import main_of
from purerl.machine import command_errors, output


@dataclass(frozen=True)
class NewOptions:
    """Writes a project of your own that trains at once."""

    name: Annotated[Path, tyro.conf.Positional]
    """The folder to make, here or by its path; its last part is a Python name, such as my_robot."""


def command(options: NewOptions) -> None:
    """Writes the files, and says how to go on."""
    from purerl.experiment.new_project import write_project

    output.show(*map(str, write_project(options.name)), "", f"cd {shlex.quote(str(options.name))}")
    output.show("python -m purerl.check experiment.py    # what can be checked before training")
    output.show("python -m purerl.run experiment.py      # trains it")


main = main_of(NewOptions, command, "python -m purerl.new")


if __name__ == "__main__":
    command_errors.leave(main)
