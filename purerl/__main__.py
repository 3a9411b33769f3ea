"""Lists the commands: `python -m purerl [COMMAND ...]`, or `purerl [COMMAND ...]`."""

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

from purerl.core.errors import USAGE, UserError, unknown_name
from purerl.runs.command_errors import leave, tell
from purerl.runs.experiment import summary
from purerl.runs.output import show

COMMANDS = ("run", "evaluate", "render", "record", "export", "compare")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command, or prints the list of them; returns the exit code."""
    name, *rest = (sys.argv[1:] if arguments is None else list(arguments)) or [""]
    if name in COMMANDS:
        return importlib.import_module(f"purerl.{name}").main(rest)
    if name not in ("", "-h", "--help"):
        return tell(UserError(unknown_name("command", name, COMMANDS)))
    files = [Path(__file__).with_name(f"{command}.py") for command in COMMANDS]
    show(*(f"{file.stem:9} {summary(file)}" for file in files))
    show("", "Options of a command: python -m purerl COMMAND --help")
    return 0 if name else USAGE


def console() -> None:
    """Runs the console script `purerl`, which finds modules where it is called, as `-m` does."""
    sys.path.insert(0, "")
    leave(main)


if __name__ == "__main__":
    console()
