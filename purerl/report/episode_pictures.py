"""Episodes as pictures: how each state that the deterministic policy came to looked."""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.env import Env
from purerl.core.records import Array, TrainState
from purerl.experiment.objects import Setup
from purerl.physics.drawing import Picture, take_picture
from purerl.ppo.evaluation import Progress
from purerl.report.episode_arrays import play

MAX_FRAMES_PER_SECOND = 50.0


class Recording(NamedTuple):
    """Episodes from their first state on, [K, N, ...]: K = 1 + control steps, N episodes."""

    pictures: Picture
    shown: Array  # [K, N] bool: whether the episode still ran when it came to this state
    episode_return: Array  # [N] of the part that was recorded
    length: Array  # [N] int32 control steps recorded
    over: Array  # [N] bool: whether the episode ended, or was only cut


def recording_of(env: Env, pictures: Picture, running: Array, end: Progress) -> Recording:
    """Returns episodes as a recording.

    Args:
      env: the environment.
      pictures: of the states before each step, [T, N, ...].
      running: [T, N] whether the step belongs to the episode, and left a state of finite numbers:
        a lost state is not drawn, since it has numbers that no camera can point at.
      end: the episodes after the last step.
    """
    last = jax.vmap(functools.partial(take_picture, env))(end.env_state)
    whole = jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), pictures, last)
    shown = jnp.concatenate([jnp.ones((1, running.shape[1]), bool), running])
    return Recording(whole, shown, end.episode.episode_return, end.episode.length, end.over)


def record(setup: Setup, state: TrainState, key: Array, number: int, steps: int) -> Recording:
    """Plays episodes and keeps how every state looked; pure. Arguments: see `play`."""
    end, rows = play(setup, state, key, number, steps)
    pictures = jax.vmap(jax.vmap(functools.partial(take_picture, setup.env)))(rows["state"])
    return recording_of(setup.env, pictures, rows["running"], end)


def frame_stride(control_timestep: float) -> int:
    """Returns how many control steps [s] pass from frame to frame, for at most 50 frames a second.

    The frame rate is `1 / (stride * control_timestep)`, so a video runs in real time.
    """
    return max(1, math.ceil(1.0 / (MAX_FRAMES_PER_SECOND * control_timestep) - 1e-6))


def episode_pictures(recording: Recording, episode: int, stride: int) -> list[Picture]:
    """Returns the pictures of one episode that are drawn: each `stride`-th, and the last."""
    last = int(recording.shown[:, episode].sum()) - 1
    steps = (*range(0, last, stride), last)
    return [jax.tree.map(lambda x, t=t: x[t, episode], recording.pictures) for t in steps]
