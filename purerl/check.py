"""Checks an experiment before it is trained: `python -m purerl.check EXPERIMENT [--ppo.clip 0.1]`.

EXPERIMENT and its settings are those of `python -m purerl.run`. One line for each thing that was
looked at: ok, warning or error. Environment, network, sizes, memory and speed; nothing is written.

Exit codes: 0 no error, 1 an error was found, 2 a mistake in the command.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass

from purerl.core.errors import FAILURE, USAGE, RunError, UserError
from purerl.experiment import loading, options
from purerl.machine import output
from purerl.machine.command_errors import leave, tell


@dataclass(frozen=True)
class CheckOptions(options.RunOptions):
    """What `run` takes, and what is left out here."""

    speed: bool = True
    """Measure how fast it is; --no-speed: do not."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if not arguments or arguments[0] in ("-h", "--help"):
        output.show(*str(__doc__).split("\n"), "--no-speed: do not measure how fast it is.")
        return 0 if arguments else USAGE
    try:
        return _command(arguments)
    except (UserError, RunError) as error:
        return tell(error)


def _command(arguments: Sequence[str]) -> int:
    """Prints each finding when it is found."""
    from purerl.checks.user_code import program_errors
    from purerl.devices import compilation
    from purerl.experiment.command_line import from_command_line
    from purerl.experiment.examine import examine
    from purerl.training import train

    train.set_xla_flags_in_time()
    if not arguments or arguments[0].startswith("-"):
        raise UserError(
            "The first word must be the experiment: python -m purerl.check EXPERIMENT "
            "[--option value ...]"
        )
    source = loading.find_source(arguments[0])
    prog = f"python -m purerl.check {arguments[0]}"
    chosen, given = from_command_line(source, arguments[1:], prog, base=CheckOptions)
    compilation.set_up_jax(given.cache)
    levels: list[str] = []
    with program_errors():
        for finding in examine(chosen, given.speed):
            output.show(str(finding))
            levels.append(finding.level)
    counts = {kind: levels.count(kind) for kind in ("error", "warning")}
    words = [f"{n} {kind}{'s' * (n != 1)}" for kind, n in counts.items()]
    output.show(f"{source.name}: {', '.join(words)}")
    return FAILURE if counts["error"] else 0


if __name__ == "__main__":
    leave(main)
