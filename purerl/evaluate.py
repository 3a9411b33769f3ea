"""Evaluates a run: `python -m purerl.evaluate RUN [--episodes 100] [--checkpoint best] [--json F]`.

RUN is a run's folder; nothing else is needed, and nothing in it is changed.
"""

import json
from dataclasses import dataclass
from pathlib import Path

from purerl.experiment.command_line import main_of
from purerl.experiment.options import PlayOptions
from purerl.machine import command_errors, files, output
from purerl.runs.loaded_run import Evaluated, load


@dataclass(frozen=True)
class EvaluateOptions(PlayOptions):
    """Evaluates a run's policy on whole episodes in fresh environments."""

    episodes: int = 100
    """Whole episodes, each in an environment of its own."""
    stochastic: bool = False
    """Sample actions instead of taking the distribution's centre."""
    json: Path | None = None
    """Also write the result to this file as JSON, every episode's figures included."""


def command(options: EvaluateOptions) -> None:
    """Evaluates, prints the figures, and writes the file that was asked for."""
    file = options.json
    if file is not None:
        files.check_writable(file)
    run = load(options.run, options.checkpoint, options.engine, options.trust)
    result = run.evaluate(options.episodes, options.seed, options.stochastic)
    output.show(*describe(result))
    if file is not None:  # last: where the disk is full, the figures are on the screen
        files.write_answer(file, (json.dumps(result, indent=2) + "\n").encode())


def describe(result: Evaluated) -> list[str]:
    """Returns the result as lines for a person, the return first."""
    ordered = {"episode_return": result["metrics"]["episode_return"]} | result["metrics"]
    width = max(map(len, ordered))
    return [
        f"{result['run']}, update {result['update']:,} ({result['steps']:,} steps), "
        f"{result['policy']} policy, engine {result['engine']}, N = {result['episodes']} episodes",
        f"{'':{width}}  {'mean':>12} {'std':>12} {'min':>12} {'max':>12}",
        *(
            f"{name:{width}}  {s['mean']:12.4f} {s['std']:12.4f} {s['min']:12.4f} {s['max']:12.4f}"
            for name, s in ordered.items()
        ),
    ]


main = main_of(EvaluateOptions, command, "python -m purerl.evaluate")


if __name__ == "__main__":
    command_errors.leave(main)
