"""An environment of brax or MuJoCo Playground as one of ours.

Theirs are pure functions too, `reset(key)` and `step(state, action)`, of a state that is a pytree.
Only the bare environment is used, none of their wrappers: time limits and resets are the trainer's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from purerl.core.env import State
from purerl.core.records import Array, PyTree, is_key
from purerl.physics.interface import PhysicsState


@dataclass(frozen=True)
class Drawn:
    """What drawing, recording and the manifest need of a physics."""

    model: mujoco.MjModel


@dataclass(frozen=True)
class ForeignEnv:
    """Their environment behind our protocol."""

    env: Any  # theirs
    template: PyTree  # shapes of their state
    simulation: Callable[[Any], Any]  # their state -> what has qpos and qvel of the model, or None
    physics: Drawn | None
    action_size: int
    control_timestep: float  # [s]

    def reset(self, key: Array) -> State:
        """Starts an episode."""
        return self._convert(self.env.reset(key))

    def step(self, state: State, action: Array) -> State:
        """Advances one control step; action [A] in [-1, 1]."""
        return self._convert(self.env.step(unpack(state.task, self.template), action))

    def _convert(self, theirs: Any) -> State:
        """Returns our state. All of theirs is in `task`."""
        done = jnp.asarray(theirs.done, jnp.float32) > 0.5
        # So Playground tells a time limit of its own from the end of the task.
        late = jnp.asarray(theirs.info.get("time_out", 0.0), jnp.float32) > 0.5
        return State(
            physics=look(self.simulation(theirs)),
            observation=jax.tree.map(float32, _observation(theirs.obs)),
            reward=float32(theirs.reward),
            terminated=done & ~late,
            truncated=done & late,
            metrics={name: float32(value) for name, value in theirs.metrics.items()},
            task=pack(theirs, self.template),
        )


def adapt(
    env: Any, model: mujoco.MjModel | None, simulation: Callable[[Any], Any], timestep: float
) -> ForeignEnv:
    """Returns their environment as ours.

    Args:
      env: theirs.
      model: the MuJoCo model that it simulates, to draw it; or None.
      simulation: their state to its simulation.
      timestep: of control [s].
    """
    template = jax.eval_shape(env.reset, jax.random.key(0))
    drawn = Drawn(model) if model is not None else None
    return ForeignEnv(env, template, simulation, drawn, int(env.action_size), timestep)


def float32(x: Any) -> Array:
    """Returns a float32 array without JAX's weak type, which would compile twice."""
    return jax.lax.convert_element_type(jnp.asarray(x), jnp.float32)


def _observation(seen: Any) -> PyTree:
    """Names as ours: the policy reads the entry "policy", the value function all."""
    if not hasattr(seen, "items"):
        return seen
    return {"policy" if name == "state" else name: x for name, x in seen.items()}


def look(simulation: Any) -> PyTree:
    """Returns what can be seen of a simulation, and tells whether it is lost.

    The rest of MJX's data is no measure of that: it has numbers of 1e15 where all is well.
    """
    names = ("qpos", "qvel", "act", "time", "qacc_warmstart", "mocap_pos", "mocap_quat")
    if not all(hasattr(simulation, name) for name in names):
        return [float32(x) for x in (simulation.q, simulation.qd)]
    return PhysicsState(**{name: float32(getattr(simulation, name)) for name in names})


def pack(theirs: PyTree, template: PyTree) -> list[Array]:
    """Returns a state's arrays with floats as their bits, and keys as numbers."""

    def one(x: Any, like: Any) -> Array:
        if is_key(like):
            return jax.random.key_data(x)
        x = jax.lax.convert_element_type(jnp.asarray(x), like.dtype)
        return jax.lax.bitcast_convert_type(x, jnp.uint32) if like.dtype == jnp.float32 else x

    return [one(*pair) for pair in zip(*map(jax.tree.leaves, (theirs, template)), strict=True)]


def unpack(packed: list[Array], template: PyTree) -> Any:
    """Returns the state that `pack` was given, to the bit."""

    def one(x: Array, like: Any) -> Array:
        if is_key(like):
            impl = str(jax.random.key_impl(jnp.empty((0,), like.dtype)))
            return jax.random.wrap_key_data(x, impl=impl)
        return jax.lax.bitcast_convert_type(x, jnp.float32) if like.dtype == jnp.float32 else x

    leaves, tree = jax.tree.flatten(template)
    return jax.tree.unflatten(tree, [one(*pair) for pair in zip(packed, leaves, strict=True)])
