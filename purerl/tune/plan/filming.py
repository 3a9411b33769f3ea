"""Videos of planned episodes, drawn as those of a run's policy are."""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from purerl.core.env import Env
from purerl.report.episode_pictures import Recording, take_picture
from purerl.report.video import draw, renderer_of
from purerl.tune.plan.episodes import Playing


def film(
    path: Path, env: Env, size: tuple[int, int], end: Playing, rows: Sequence[dict[str, Any]]
) -> None:
    """Writes a video of episodes.

    Args:
      path: of the mp4.
      env: the environment.
      size: width and height of a frame [pixels].
      end: the episodes, over.
      rows: of `episodes.episodes`, with pictures kept.
    """
    last = jax.device_get(jax.vmap(functools.partial(take_picture, env))(end.progress.env_state))
    kept = [row["kept"] for row in rows] + [jax.tree.map(lambda x: x[None], last)]
    pictures = jax.tree.map(lambda *parts: np.concatenate(parts), *kept)
    running = np.concatenate([row["running"] for row in rows])
    shown = np.concatenate([np.ones((1, running.shape[1]), bool), running])
    episode = end.progress.episode
    played: tuple[Any, ...] = (episode.episode_return, episode.length, end.progress.over)
    recording = Recording(pictures, shown, *map(np.asarray, played))  # type: ignore[arg-type]
    with renderer_of(env, size) as renderer:
        draw(path, renderer, recording, env.control_timestep)
