"""Episodes as they were: what the deterministic policy did, state by state, ready to be drawn.

An environment that can be drawn holds its `physics` (`Physics`), and its states hold
that one's PhysicsState. Two methods are optional:

- `model_changes(state) -> {field: array}`: this episode's model fields, of the fields' own shapes,
  as its own `step` gives them to `Physics.step`. They are drawn as they were.
- `scenery(state) -> (centers [P, 3], half_sizes [P, 3])` [m]: boxes that belong to the episode but
  are not all in the model at once, such as the far platforms of a corridor. Only drawn.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.env import Env, State
from purerl.core.errors import UserError
from purerl.core.records import Array, Network, TrainState
from purerl.physics.interface import Physics
from purerl.ppo import distributions
from purerl.ppo.config import Config
from purerl.ppo.evaluation import Progress, advance, start
from purerl.ppo.rollout import act

MAX_FRAMES_PER_SECOND = 50.0


class Picture(NamedTuple):
    """All that decides how one state looks; leading axes are the caller's."""

    qpos: Array  # [..., nq]
    mocap_pos: Array  # [..., nmocap, 3] [m]
    mocap_quat: Array  # [..., nmocap, 4]
    changes: dict[str, Array]  # MjModel field -> its values
    scenery: tuple[Array, ...]  # () or centers and half sizes of boxes, [..., P, 3] each [m]


class Recording(NamedTuple):
    """Episodes from their first state on, [K, N, ...]: K = 1 + control steps, N episodes."""

    pictures: Picture
    shown: Array  # [K, N] bool: whether the episode still ran when it came to this state
    episode_return: Array  # [N] of the part that was recorded
    length: Array  # [N] int32 control steps recorded
    over: Array  # [N] bool: whether the episode ended, or was only cut


def physics_of(env: Env) -> Physics:
    """Returns the environment's Physics; UserError if it has none, so cannot be drawn."""
    physics = getattr(env, "physics", None)
    if not isinstance(physics, Physics):
        raise UserError(
            f"The environment {type(env).__name__} cannot be drawn: it has no `physics` of the "
            "type purerl.physics.interface.Physics."
        )
    return physics


def record(
    config: Config,
    env: Env,
    network: Network,
    state: TrainState,
    key: Array,
    num_episodes: int,
    num_steps: int,
) -> Recording:
    """Plays N episodes by the deterministic policy and keeps how every state looked; pure.

    Args:
      config: for the time limit.
      env: the environment, with `physics`.
      network: the network.
      state: for `params` and `normalizer`, and the shape of one environment's memory.
      key: [] typed; must not be one that training uses.
      num_episodes: N.
      num_steps: control steps to record at most.
    """
    take = jax.vmap(functools.partial(take_picture, env))

    def step(progress: Progress, _: None) -> tuple[Progress, tuple[Picture, Array]]:
        output, memory = act(network, state, progress.env, progress.memory)
        action = distributions.to_action(output.distribution.loc)
        following = advance(env, progress, action, memory)
        # A lost state is not drawn: it has numbers that no camera can point at.
        return following, (take(following.env), ~progress.over & ~following.lost)

    begin = start(config, env, state, key, num_episodes)
    end, later = jax.lax.scan(step, begin, length=num_steps)
    first = (take(begin.env), jnp.ones(num_episodes, bool))
    pictures, shown = jax.tree.map(lambda a, rest: jnp.concatenate([a[None], rest]), first, later)
    return Recording(pictures, shown, end.episode.episode_return, end.episode.length, end.over)


def take_picture(env: Any, state: State) -> Picture:
    """Keeps what decides how one environment's state looks."""
    changes = env.model_changes(state) if hasattr(env, "model_changes") else {}
    scenery = env.scenery(state) if hasattr(env, "scenery") else ()
    physics = state.physics
    return Picture(physics.qpos, physics.mocap_pos, physics.mocap_quat, changes, tuple(scenery))


def frame_stride(control_timestep: float) -> int:
    """Returns how many control steps [s] pass from frame to frame, for at most 50 frames a second.

    The frame rate is `1 / (stride * control_timestep)`, so a video runs in real time.
    """
    return max(1, math.ceil(1.0 / (MAX_FRAMES_PER_SECOND * control_timestep) - 1e-6))


def episode_pictures(recording: Recording, episode: int, stride: int) -> list[Picture]:
    """Returns the pictures of one episode that are drawn: each `stride`-th, and the last."""
    number = int(np.sum(recording.shown[:, episode]))
    steps = list(range(0, number, stride))
    if steps[-1] != number - 1:
        steps.append(number - 1)
    return [_at(recording.pictures, step, episode) for step in steps]


def _at(pictures: Picture, step: int, episode: int) -> Picture:
    return jax.tree.map(lambda x: x[step, episode], pictures)
