"""Plans an experiment's behaviour: `python -m purerl.plan EXPERIMENT_OR_RUN [--planner mppi]`.

Nothing is learned: before each action, plans are tried in the simulation. Of a run, plans correct
its policy's actions, and stand beside the policy alone.

With --against SETTINGS, the same episodes are planned under other settings of the environment too,
beside those before it, and both behaviours are judged by both rewards:

    python -m purerl.plan rodent_run --episodes 5 --against --env.forward-weight 2
"""

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

from purerl.experiment.command_line import main_of_words
from purerl.machine import command_errors, files, output, signals

PROG = "python -m purerl.plan"


def show_help(words: Sequence[str]) -> None:
    """Prints the help page."""
    from purerl.tune import subject
    from purerl.tune.plan.problem import PlanCommandOptions

    subject.show_help(PlanCommandOptions, __doc__, PROG, words)


def command(words: Sequence[str]) -> None:
    """Plans, prints the figures, and writes the files that were asked for."""
    from purerl.devices.compilation import set_up_jax
    from purerl.machine.state_arrays import digest_leaves, flatten
    from purerl.report.comparison import episodes_csv
    from purerl.report.opengl import choose_gl
    from purerl.training.train import set_xla_flags_in_time
    from purerl.tune.plan import figures
    from purerl.tune.plan.play import play
    from purerl.tune.plan.problem import read
    from purerl.tune.plan.settings import NO_SEARCH

    if any(word.startswith("--video") for word in words):
        choose_gl()  # before mujoco is imported, which looks for OpenGL itself
    set_xla_flags_in_time()
    set_up_jax(cache=True)
    first, second, options = read(words, PROG)
    problems = [first] if second is None else [first, second]
    judges = {one.title: one.setup.env for one in problems} if second else {}
    played = {}
    with signals.stop_signals(os._exit, "stopping after the present steps") as stop:
        if second is None and first.learned is not None:
            alone = dataclasses.replace(options, **NO_SEARCH, video=None)
            played["policy"] = play(first._replace(title="policy"), alone, {}, stop)
        for one in problems:
            played[one.title] = play(one, options, judges, stop)
    groups = {name: figures.compared(x.figures, x.judged) for name, x in played.items()}
    said = figures.table(groups) + figures.notes({n: x.figures for n, x in played.items()})
    starts = {digest_leaves(flatten(x.starts)) for x in played.values()}
    if second is not None and len(starts) > 1:
        said.append(
            "The two settings begin their episodes otherwise: what differs is not their rewards' "
            "doing alone."
        )
    output.show(*titles(problems), *said)
    whole = {name: x.figures | x.judged for name, x in played.items()}
    if options.csv is not None:
        each = [({"settings": name}, x) for name, x in whole.items()]
        files.write_answer(options.csv, episodes_csv(each))
    if options.json is not None:
        about: dict[str, Any] = {"problem": first.name, "trained": first.trained}
        about["environments"] = {one.title: one.settings for one in problems}
        about |= {"engine": first.setup.engine} | dataclasses.asdict(options)
        files.write_answer(options.json, figures.as_json(whole, about).encode())


def titles(problems: Sequence[Any]) -> list[str]:
    """Returns lines that say what was planned for."""
    if len(problems) > 1:
        file = "as in the experiment's file"
        return [f"{one.title}: {one.words or file}" for one in problems]
    return [f"{one.name}, {one.trained}" for one in problems if one.trained]


main = main_of_words(command, show_help)


if __name__ == "__main__":
    command_errors.leave(main)
