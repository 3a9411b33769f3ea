"""One environment, or several, stepped from Python: what the adapters to other libraries share."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.env import Env, State
from purerl.core.errors import UserError
from purerl.core.records import Array, PyTree
from purerl.ppo.episodes import is_lost


def sound_step(env: Env) -> Callable[[State, Array], tuple[State, Array]]:
    """Returns `env.step`, and whether the simulation was lost, [] bool.

    Other libraries know no lost simulation: it is truncated, has the observation before it and a
    reward of 0. Then no NaN reaches the learner.
    """

    def step(before: State, action: Array) -> tuple[State, Array]:
        state = env.step(before, action)
        lost = is_lost(state)

        def unless_lost(new: PyTree, old: PyTree) -> PyTree:
            return jax.tree.map(lambda n, o: jnp.where(lost, o, n), new, old)

        kept = state.replace(
            observation=unless_lost(state.observation, before.observation),
            reward=jnp.where(lost, 0.0, state.reward),
            terminated=state.terminated & ~lost,
            truncated=(state.truncated | lost) & ~state.terminated | lost,
            metrics=unless_lost(state.metrics, before.metrics),
        )
        return kept, lost

    return step


def example(env: Env) -> State:
    """Returns the shapes of one environment's state."""
    return jax.eval_shape(env.reset, jax.random.key(0))


def to_numpy(tree: PyTree) -> Any:
    """Returns copies that the caller may change."""
    return jax.tree.map(np.array, tree)


def check_length(episode_length: int) -> int:
    """Returns the time limit; UserError if it is none."""
    if episode_length < 1:
        raise UserError(f"episode_length is {episode_length}; it must be at least 1.")
    return episode_length
