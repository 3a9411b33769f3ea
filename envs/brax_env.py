"""An environment of brax as one of this library: for comparing trainers on one body.

Needs the `peers` extra. Only brax's bare environment is used, none of its wrappers: time limits and
resets are the trainer's here.
"""

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp

from purerl.env import State
from purerl.types import Array, PyTree


@dataclasses.dataclass(frozen=True)
class Options:
    """Which of brax's environments."""

    name: str = "ant"
    """As brax calls it: ant, humanoid, halfcheetah, ..."""
    backend: Literal["mjx", "generalized", "spring", "positional"] = "mjx"
    """Which of brax's physics; they are models of different bodies, not only engines."""


@dataclasses.dataclass(frozen=True)
class BraxEnv:
    """The environment; `build` makes one."""

    env: Any  # brax's
    record: Any  # brax's class of states
    action_size: int
    control_timestep: float  # [s]

    def reset(self, key: Array) -> State:
        """Starts an episode."""
        return convert(self.env.reset(key))

    def step(self, state: State, action: Array) -> State:
        """Advances one control step; action [A] in [-1, 1]."""
        before = self.record(
            pipeline_state=state.physics,
            obs=state.observation,
            reward=state.reward,
            done=state.terminated.astype(jnp.float32),
            metrics=dict(state.metrics),
            info=dict(state.task),
        )
        return convert(self.env.step(before, action))


def convert(state: Any) -> State:
    """Turns brax's state into ours; its weak types, which would compile twice, into plain ones."""
    metrics = {name: jnp.asarray(value, jnp.float32) for name, value in state.metrics.items()}
    return State(
        physics=plain(state.pipeline_state),
        observation=plain(state.obs),
        reward=plain(jnp.asarray(state.reward, jnp.float32)),
        terminated=plain(jnp.asarray(state.done, jnp.float32)) > 0.5,
        truncated=jnp.zeros((), bool),
        metrics=plain(metrics),
        task=plain(state.info),
    )


def plain(tree: PyTree) -> PyTree:
    """Returns a tree without weak types."""
    arrays = jax.tree.map(jnp.asarray, tree)
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), arrays)


def build(options: Options = Options(), engine: str = "auto") -> BraxEnv:  # noqa: B008
    """Builds the environment; it has one engine, brax's own, whatever `engine` says."""
    from brax import envs

    env = envs.get_environment(options.name, backend=options.backend)
    return BraxEnv(env, envs.State, int(env.action_size), float(env.dt))
