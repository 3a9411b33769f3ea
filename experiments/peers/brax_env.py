"""An environment of brax as one of this library: for comparing trainers on one body.

Needs the `peers` extra. Only brax's bare environment is used, none of its wrappers: time limits and
resets are the trainer's here. It is stepped by brax's physics or by ours; observation, reward, end
and start are brax's own code with either.
"""

import copy
import dataclasses
import importlib.util
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco
from flax import struct

from purerl.core.env import State
from purerl.core.records import Array, PyTree
from purerl.exact.constants import on_cpu
from purerl.physics.interface import Physics, PhysicsState

READINGS = ("xpos", "xquat", "cvel", "subtree_com")


@dataclasses.dataclass(frozen=True)
class Options:
    """Which of brax's environments."""

    name: str = "ant"
    """As brax calls it: ant, humanoid, halfcheetah, ..."""
    backend: Literal["mjx", "purerl", "generalized", "spring", "positional"] = "mjx"
    """Which physics. "mjx" is brax's way of calling MJX, "purerl" ours, of the same MuJoCo model;
    the others of brax are models of different bodies, not only engines."""


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

    def step_physics(self, physics: PyTree, action: Array) -> PyTree:
        """Advances the physics alone by one control step; as `State.physics` in and out."""
        return self.env.pipeline_step(physics, action)


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


class Simulation(struct.PyTreeNode):
    """One simulation on our physics, under the names by which brax's environments read it.

    Links are current. With "mjx" they are those before the last physics step, as MJX leaves them.
    """

    physics: PhysicsState
    x: Any  # brax's Transform [L]: links' positions [m] and rotations
    xd: Any  # brax's Motion [L]: links' velocities [m/s] and [rad/s], in the world's frame

    @property
    def q(self) -> Array:
        """Positions [nq]."""
        return self.physics.qpos

    @property
    def qd(self) -> Array:
        """Velocities [nv]."""
        return self.physics.qvel


def own_model(system: Any) -> mujoco.MjModel:
    """Returns the MuJoCo model of brax's system, with the options that brax changed afterwards."""
    model = copy.copy(system.mj_model)
    for name in ("timestep", "solver", "disableflags", "iterations", "ls_iterations"):
        kind = type(getattr(model.opt, name))
        setattr(model.opt, name, kind(getattr(system.opt, name)))
    return model


def simulate(model: mujoco.MjModel, physics: PhysicsState, readings: Any) -> Simulation:
    """Turns our readings into brax's records; the world, body 0, is no link there."""
    from brax.base import Motion, Transform

    angular, linear = readings.cvel[1:, :3], readings.cvel[1:, 3:]
    # MuJoCo's velocity is that of the point of the body which is at the tree's centre of mass.
    offset = readings.xpos[1:] - readings.subtree_com[model.body_rootid[1:]]
    return Simulation(
        physics=physics,
        x=Transform(pos=readings.xpos[1:], rot=readings.xquat[1:]),
        xd=Motion(ang=angular, vel=linear + jnp.cross(angular, offset)),
    )


def begin(physics: Physics, q: Array, qd: Array) -> Simulation:
    """Starts a simulation, as brax's `pipeline_init`."""
    return simulate(physics.model, *physics.init(q, qd))


def advance(physics: Physics, simulation: Simulation, ctrl: Array) -> Simulation:
    """Advances one control step, as brax's `pipeline_step`."""
    return simulate(physics.model, *physics.step(simulation.physics, ctrl))


def put_on_our_physics(env: Any, engine: str) -> None:
    """Makes a newly built environment of brax call our physics where it called its own."""
    substeps = round(float(env.dt) / float(env.sys.opt.timestep))
    physics = Physics(own_model(env.sys), READINGS, substeps, engine)
    env.pipeline_init = partial(begin, physics)
    env.pipeline_step = partial(advance, physics)


def build(options: Options = Options(), engine: str = "auto") -> BraxEnv:  # noqa: B008
    """Builds the environment; `engine` is that of our physics, and brax's have one each."""
    if importlib.util.find_spec("brax") is None:
        raise ImportError(
            f"{options.name!r} is an environment of brax, which is not installed: "
            "pip install -c constraints.txt -e '.[peers]'"
        )
    from brax import envs

    ours = options.backend == "purerl"
    with on_cpu():
        env = envs.get_environment(options.name, backend="mjx" if ours else options.backend)
    if ours:
        put_on_our_physics(env, engine)
    return BraxEnv(env, envs.State, int(env.action_size), float(env.dt))
