"""Episodes that the command plans: telling how it goes, stopping when asked to."""

import dataclasses
import functools
import operator
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from purerl.checks.user_code import users_errors
from purerl.core.env import Env
from purerl.core.errors import StoppedError
from purerl.experiment.objects import naming_broken_rules
from purerl.machine import output
from purerl.report import episode_pictures, video
from purerl.tune.plan import episodes, figures, planner

FRAME = (640, 480)  # of a video [pixels]
SAY = 10.0  # between two lines about how it goes [s]
WAIT = 0.002  # between two looks for a signal [s]


class Played(NamedTuple):
    """Episodes that have been played."""

    figures: dict[str, Any]  # name -> [E]
    judged: dict[str, Any]  # the judges' figures
    starts: Any  # how the episodes began, for a comparison


def play(problem: Any, options: Any, judges: dict[str, Any], stop: Callable[[], bool]) -> Played:
    """Plays episodes, telling how it goes.

    Args:
      problem: what is planned for.
      options: of the command.
      judges: see `episodes.advance`.
      stop: tells whether a signal asked to stop.

    Raises:
      StoppedError: one did.
    """
    config, env, network, _ = problem.setup
    limit = options.steps or config.episode_length
    config = dataclasses.replace(config, episode_length=limit)

    guide = functools.partial(planner.guide_of, config, env, network)
    # Episodes that begin alike are known by what is observed.
    observation = operator.attrgetter("observation")
    keep = functools.partial(episode_pictures.take_picture, env) if options.video else observation
    game = (config, options, env, guide, problem.learned, options.seed, options.episodes)
    rows: list[Any] = []
    begin = spoke = time.perf_counter()
    with users_errors(""), naming_broken_rules(env):
        for now, computed in episodes.episodes(*game, judges, keep):
            while not all(x.is_ready() for x in jax.tree.leaves(computed)):
                time.sleep(WAIT)  # in Python, where a signal is heard: inside JAX none is
            rows.append(jax.device_get(computed))
            clock = time.perf_counter()
            if len(rows) == 1:
                begin = clock  # what came before was compiling
            said = progress(problem.title, now, limit, clock - begin, len(rows))
            if stop():
                raise StoppedError(f"Stopped ({said}): no figures, and no file was written.")
            if clock - spoke > SAY:
                spoke = clock
                output.say(said)
    if options.video is not None:
        name = f"{options.video.stem}_{problem.title}" if judges else options.video.stem
        path = options.video.with_name(f"{name}.mp4")
        film(path, env, now, rows)
        output.say(str(path))
    starts = jax.tree.map(lambda x: x[0], rows[0]["kept"])
    return Played(episodes.results(now), figures.judged(rows), starts)


def film(path: Path, env: Env, end: episodes.Playing, rows: Sequence[dict[str, Any]]) -> None:
    """Writes a video of episodes, drawn as those of a run's policy are.

    Args:
      path: of the mp4.
      env: the environment.
      end: the episodes, over.
      rows: of `episodes.episodes`, with pictures kept.
    """
    kept = [(row["kept"], row["running"]) for row in rows]
    pictures, running = jax.tree.map(lambda *parts: np.concatenate(parts), *kept)
    recording = jax.device_get(episode_pictures.recording_of(env, pictures, running, end.progress))
    with video.renderer_of(env, FRAME) as renderer:
        video.draw(path, renderer, recording, env.control_timestep)


def progress(title: str, playing: Any, limit: int, seconds: float, calls: int) -> str:
    """Returns a line about episodes that are being played."""
    done = playing.progress
    number, steps = len(done.over), min(int(done.t), limit)
    so_far = float(done.episode.episode_return.mean())
    said = f"{title}: step {steps:,} of {limit:,}, return so far {so_far:.4g}"
    if calls == 1:
        return said
    return f"{said}, {(calls - 1) * episodes.CHUNK * number / seconds:.1f} steps planned/s"
