"""Small environments of which the best action is known."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl import State


def state(place, reward=0.0, terminated=False, truncated=False, steps=0) -> State:
    return State(
        physics=jnp.asarray(place, jnp.float32),
        observation=jnp.asarray(place, jnp.float32)[None],
        reward=jnp.asarray(reward, jnp.float32),
        terminated=jnp.asarray(terminated),
        truncated=jnp.asarray(truncated),
        metrics={"place": jnp.asarray(place, jnp.float32)},
        task=jnp.asarray(steps, jnp.int32),
    )


class Point(NamedTuple):
    """A point at x that an action moves by 0.1; reward -weight x^2 after the step."""

    weight: float = 1.0
    control_timestep: float = 0.1
    action_size: int = 1

    def reset(self, key) -> State:
        return state(jax.random.uniform(key, minval=0.5, maxval=1.0))

    def step(self, now: State, action) -> State:
        place = now.physics + 0.1 * jnp.clip(action[0], -1.0, 1.0)
        return state(place, -self.weight * place**2)


class Ending(NamedTuple):
    """Pays 1 a step, ends in its third step, and goes on paying; the action is thrown away."""

    how: str = "terminated"
    after: float = 1.0  # the reward after the end
    control_timestep: float = 0.1
    action_size: int = 1

    def reset(self, key) -> State:
        return state(0.0)

    def step(self, now: State, action) -> State:
        steps = now.task + 1
        place = jnp.where((self.how == "lost") & (steps == 3), jnp.nan, now.physics)
        ends = {self.how: steps == 3} if self.how in ("terminated", "truncated") else {}
        return state(place, jnp.where(steps > 3, self.after, 1.0), steps=steps, **ends)
