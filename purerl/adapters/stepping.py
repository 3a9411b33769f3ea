"""One environment, or several, stepped from Python: what the adapters to other libraries share."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from purerl.core.env import Env, State
from purerl.core.errors import UserError
from purerl.core.records import Array, PyTree
from purerl.physics import drawing
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


class Drawer:
    """Draws an environment that has a model, by MuJoCo's renderer, as a video of a run shows it."""

    def __init__(self, env: Env, height: int = 480, width: int = 640) -> None:
        """Prepares pictures [height, width, 3]; UserError if there is no model to draw."""
        model = getattr(getattr(env, "physics", None), "model", None)
        if model is None:
            raise UserError("This environment cannot be drawn: it has no physics.model.")
        height = min(height, model.vis.global_.offheight)
        width = min(width, model.vis.global_.offwidth)
        self.stage = drawing.Stage(model)
        self.renderer = mujoco.Renderer(self.stage.model, height, width)
        self._take = jax.jit(functools.partial(drawing.take_picture, env))

    def draw(self, state: State) -> np.ndarray:
        """Returns the picture of a state, uint8 [height, width, 3]."""
        picture = jax.device_get(self._take(state))
        self.stage.pose(picture)
        self.renderer.update_scene(self.stage.data, self.stage.camera)
        drawing.add_scenery(self.renderer.scene, picture.scenery)
        return self.renderer.render()
