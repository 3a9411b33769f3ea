"""Lists the commands: `python -m purerl [COMMAND ...]`, or `purerl [COMMAND ...]`."""

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

from purerl import __version__
from purerl.core.errors import USAGE, UserError, unknown_name
from purerl.experiment.loading import summary
from purerl.machine import command_errors, output

COMMANDS = (
    "new", "check", "run", "evaluate", "ask", "render", "view", "record", "export", "pack",
    "compare", "report", "plot", "sweep", "plan", "clips",
)  # fmt: skip

HERE = Path(__file__).parent


def module_of(command: str) -> str:
    """Returns a command's module below `purerl`: a file's, or that of a room of its name."""
    return f"{command}.__main__" if (HERE / command).is_dir() else command


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command, or prints the list of them; returns the exit code."""
    name, *rest = (sys.argv[1:] if arguments is None else list(arguments)) or [""]
    if name in COMMANDS:
        return importlib.import_module(f"purerl.{module_of(name)}").main(rest)
    if name == "--version":
        output.show(__version__)
        return 0
    if name not in ("", "-h", "--help"):
        return command_errors.tell(UserError(unknown_name("command", name, COMMANDS)))
    for command in COMMANDS:
        file = HERE / f"{module_of(command).replace('.', '/')}.py"
        output.show(f"{command:9} {summary(file)}")
    output.show("", "Options of a command: python -m purerl COMMAND --help")
    return 0 if name else USAGE


def console() -> None:
    """Runs the console script `purerl`, which finds modules where it is called.

    It looks there last: whatever a folder has, this library finds Python's and its own packages.
    """
    sys.path.append("")
    command_errors.leave(main)


if __name__ == "__main__":
    console()
