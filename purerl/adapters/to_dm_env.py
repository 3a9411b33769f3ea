"""Our environments as `dm_env.Environment`."""

from typing import Any

import dm_env
import jax
import numpy as np
from dm_env import specs

from purerl.adapters.stepping import check_length, example, sound_step, to_numpy
from purerl.core.env import Env


class DmEnvironment(dm_env.Environment):
    """One of our environments as a `dm_env.Environment`."""

    def __init__(self, env: Env, episode_length: int = 1000, seed: int = 0) -> None:
        """Compiles nothing yet.

        Args:
          env: the environment.
          episode_length: control steps until it is truncated (a last step with discount 1).
          seed: of the episodes' starts.
        """
        self.env, self.episode_length = env, check_length(episode_length)
        self._key, self._episodes = jax.random.key(seed), 0
        self._shapes = example(env).observation
        self._reset, self._step = jax.jit(env.reset), jax.jit(sound_step(env))
        self._over = True

    def reset(self) -> dm_env.TimeStep:
        """Starts an episode; the first ones of a seed are always the same."""
        self._state = self._reset(jax.random.fold_in(self._key, self._episodes))
        self._episodes, self._steps, self._over = self._episodes + 1, 0, False
        return dm_env.restart(to_numpy(self._state.observation))

    def step(self, action: Any) -> dm_env.TimeStep:
        """Advances one control step, or starts an episode where the last one is over.

        Args:
          action: [A] in [-1, 1].
        """
        if self._over:
            return self.reset()
        self._state, _ = self._step(self._state, np.asarray(action, np.float32))
        self._steps += 1
        state, late = self._state, self._steps >= self.episode_length
        seen, reward = to_numpy(state.observation), float(state.reward)
        self._over = bool(state.terminated) or bool(state.truncated) or late
        if state.terminated:
            return dm_env.termination(reward, seen)
        if self._over:
            return dm_env.truncation(reward, seen)
        return dm_env.transition(reward, seen)

    def observation_spec(self) -> Any:
        """Returns the spec of an observation, or a dict of them."""
        if isinstance(self._shapes, dict):
            return {k: specs.Array(x.shape, np.float32, k) for k, x in self._shapes.items()}
        return specs.Array(self._shapes.shape, np.float32, "observation")

    def action_spec(self) -> specs.BoundedArray:
        """Returns the spec of an action, [A] in [-1, 1]."""
        return specs.BoundedArray((self.env.action_size,), np.float32, -1.0, 1.0, "action")


dm_env_environment = DmEnvironment
