"""Trains an experiment: `python -m purerl.run EXPERIMENT [--seed 1] [--ppo.num-envs 64 ...]`.

EXPERIMENT is a name in experiments/, a path to a Python file, or a dotted module. Every setting of
the experiment can be overridden; `python -m purerl.run EXPERIMENT --help` lists them all.

The run is written to runs/<experiment>/<name>/; with --num-seeds S each seed has such a folder of
its own, <name>-seed<k>, which evaluate, render and compare take like any other.

Killed at any moment, the same command with --resume goes on from the last checkpoint to the same
result, bit for bit. SIGTERM and Ctrl-C save first; a second one stops at once.

Exit codes: 0 done, 1 the run cannot go on, 2 a mistake in the command, 3 stopped on request.
"""

import os
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from purerl.core.errors import SUCCESS, StoppedError, one_line
from purerl.experiment import loading
from purerl.experiment.command_line import main_of_words, read_experiment
from purerl.machine import command_errors, output
from purerl.report.opengl import choose_gl


def show_help(words: Sequence[str]) -> None:
    """Prints the help page, without importing JAX."""
    lines = [*str(__doc__).split("\n"), "Experiments:"]
    named = loading.available()
    width = max(map(len, named), default=0)
    lines += [f"  {name:{width}}  {loading.summary(path)}" for name, path in named.items()]
    output.show(*lines, *([] if named else ["  none in experiments/"]))


def command(words: Sequence[str]) -> int:
    """Trains; tells how to go on where it was stopped."""
    try:
        _train(words)
    except StoppedError as error:
        code = command_errors.tell(error)
        more = [] if "--resume" in words else ["--resume"]
        output.warn(f"Go on with: {shlex.join(['python', '-m', 'purerl.run', *words, *more])}")
        return code
    finally:
        output.flush_or_drop(sys.stdout)
    return SUCCESS


def _train(words: Sequence[str]) -> None:
    """Parses, trains, and with --video shows the policy of the first seed."""
    began = time.perf_counter()
    from purerl.training import loggers, train

    train.set_xla_flags_in_time()
    source, chosen, options = read_experiment(words, "python -m purerl.run", choose=train.as_begun)
    # Before mujoco is imported, which looks for OpenGL itself.
    video = options.video and _attempt("video", choose_gl)
    folders = train.train_runs(source, chosen, options, os._exit, began)
    if video:
        from purerl.devices.processes import is_first

        if is_first():
            file = _attempt("video", _show_policy, folders[0])
            if file and options.wandb != "off":
                _attempt("video at W&B", loggers.log_video, options, folders[0], Path(file))


def _show_policy(folder: Path) -> str:
    """Makes a video of a run's policy; returns its path.

    Training has ended, and nothing that cannot be printed is a failure of it.
    """
    from purerl import load, render

    trained = load(folder, trust=True)
    for line in (lines := render.make(trained, trained.experiment, render.RenderOptions())):
        output.say(line)
    return lines[-1]


def _attempt(what: str, part: Callable[..., Any], *arguments: Any) -> Any:
    """Returns what a part of making a video does; a failure is a line, and changes no exit code."""
    try:
        return part(*arguments)
    except Exception as error:
        output.warn(f"purerl: There is no {what}: {one_line(error)}")
        return None


main = main_of_words(command, show_help)


if __name__ == "__main__":
    command_errors.leave(main)
