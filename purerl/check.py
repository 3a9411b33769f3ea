"""Checks an experiment before it is trained: `python -m purerl.check EXPERIMENT [--ppo.clip 0.1]`.

EXPERIMENT and its settings are those of `python -m purerl.run`. One line for each thing that was
looked at: ok, warning or error. Environment, network, sizes, memory and speed; nothing is written.

Exit codes: 0 no error, 1 an error was found, 2 a mistake in the command.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from purerl.core.errors import FAILURE
from purerl.experiment.command_line import main_of_words, read_experiment
from purerl.experiment.options import RunOptions
from purerl.machine import command_errors, output


@dataclass(frozen=True)
class CheckOptions(RunOptions):
    """What `run` takes, and what is left out here."""

    speed: bool = True
    """Measure how fast it is; --no-speed: do not."""


def show_help(words: Sequence[str]) -> None:
    """Prints the help page."""
    output.show(*str(__doc__).split("\n"), "--no-speed: do not measure how fast it is.")


def command(words: Sequence[str]) -> int:
    """Prints each finding when it is found."""
    from purerl.checks.user_code import program_errors
    from purerl.devices import compilation
    from purerl.experiment.examine import examine
    from purerl.experiment.loading import summary
    from purerl.training import train

    train.set_xla_flags_in_time()
    source, chosen, given = read_experiment(words, "python -m purerl.check", CheckOptions)
    compilation.set_up_jax(given.cache)
    output.show(f"{source.name}: {summary(source.path)}")
    output.show("Building and compiling first: for a large body that may take two minutes.")
    levels: list[str] = []
    with program_errors():
        for finding in examine(chosen, given.speed):
            output.show(str(finding))
            levels.append(finding.level)
    counts = {kind: levels.count(kind) for kind in ("error", "warning")}
    told = [f"{n} {kind}{'s' * (n != 1)}" for kind, n in counts.items()]
    output.show(f"{source.name}: {', '.join(told)}")
    return FAILURE if counts["error"] else 0


main = main_of_words(command, show_help)


if __name__ == "__main__":
    command_errors.leave(main)
