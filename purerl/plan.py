"""Plans an experiment's behaviour: `python -m purerl.plan EXPERIMENT_OR_RUN [--planner mppi]`.

Nothing is learned: before each action, plans are tried in the simulation. Of a run, plans correct
its policy's actions, and its value counts at the horizon (--no-policy: neither).

With --against SETTINGS, the same episodes are planned under other settings of the environment too,
and both behaviours are judged by both rewards and by every metric:

    python -m purerl.plan rodent_run --episodes 5 --against --env.forward-weight 2
"""

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

from purerl.runs import output
from purerl.runs.command_errors import leave

PROG = "python -m purerl.plan"
FRAME = (640, 480)  # of a video [pixels]
BOTH = ("these settings", "against")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    from purerl.tune.plan.problem import Options
    from purerl.tune.subject import carry_out

    return carry_out(command, Options, __doc__, PROG, arguments)


def command(words: Sequence[str]) -> None:
    """Plans, writes the files that were asked for, and prints the figures."""
    from purerl.devices.compilation import set_up_jax
    from purerl.report.opengl import choose_gl
    from purerl.runs.files import write_file
    from purerl.runs.training import set_xla_flags_in_time
    from purerl.tune.plan import figures
    from purerl.tune.plan.problem import read

    if any(word.startswith("--video") for word in words):
        choose_gl()  # before mujoco is imported, which looks for OpenGL itself
    set_xla_flags_in_time()
    set_up_jax(cache=True)
    problem, other, options = read(words, PROG)
    if other is None:
        groups = {str(options.planner): play("", problem, options, {})}
    else:
        pair = dict(zip(BOTH, (problem, other), strict=True))
        judges = {title: one.setup.env for title, one in pair.items()}
        groups = {title: play(title, one, options, judges) for title, one in pair.items()}
    about = {"problem": problem.name} | dataclasses.asdict(options)
    if options.csv is not None:
        write_file(options.csv, figures.rows(groups).encode())
    if options.json is not None:
        write_file(options.json, figures.as_json(groups, about).encode())
    output.show(*figures.table(groups))


def play(title: str, problem: Any, options: Any, judges: dict[str, Any]) -> dict[str, Any]:
    """Plays episodes, telling how it goes; returns their figures, name -> [E].

    Args:
      title: of these settings, where there are two.
      problem: what is planned for.
      options: of the command.
      judges: see `episodes.advance`.
    """
    from purerl.runs.build_experiment import blame
    from purerl.runs.user_code import told
    from purerl.tune.plan import episodes, figures, planner
    from purerl.tune.plan.filming import film, keep_nothing, keep_picture

    config, env, network, _ = problem.setup
    limit = options.steps or config.episode_length
    config = dataclasses.replace(config, episode_length=limit)

    def guide(learned: Any) -> planner.Guide:
        if learned is None:
            return planner.unguided(env.action_size)
        return planner.guide(config, network, learned)

    keep = keep_picture(env) if options.video else keep_nothing
    game = (config, options, env, guide, problem.learned, options.seed, options.episodes)
    begin, rows, now = time.perf_counter(), [], None
    with told(""), blame(env):
        for now, row in episodes.episodes(*game, judges, keep):
            rows.append(row)
            if len(rows) == 1:
                begin = time.perf_counter()  # what came before was compiling
            elif len(rows) % 5 == 0:
                output.say(progress(title, now, limit, time.perf_counter() - begin, len(rows)))
    assert now is not None
    if options.video is not None:
        name = f"{options.video.stem}_{title.replace(' ', '_')}" if title else options.video.stem
        path = options.video.with_name(f"{name}.mp4")
        film(path, env, FRAME, now, rows)
        output.say(str(path))
    return episodes.results(now) | figures.judged(rows)


def progress(title: str, playing: Any, limit: int, seconds: float, calls: int) -> str:
    """Returns a line about episodes that are being played."""
    from purerl.tune.plan.episodes import CHUNK

    done = playing.progress
    number, steps = len(done.over), min(int(done.t), limit)
    rate = (calls - 1) * CHUNK * number / seconds
    return (
        f"{title + ': ' if title else ''}step {steps:,} of {limit:,}, return so far "
        f"{float(done.episode.episode_return.mean()):.4g}, {rate:.1f} plans/s"
    )


if __name__ == "__main__":
    leave(main)
