"""Run forward on a floor: dm_control's ant, rewarded for the speed of its own centre of mass.

The speed is that of the TORSO's subtree, which is the ant and nothing else. (The centre of mass of
body 0 is that of everything in the world.)
"""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
from dm_control import mjcf
from dm_control.locomotion.walkers import ant

from purerl import model as lookup
from purerl.env import State
from purerl.physics import Physics, PhysicsState, choose_engine
from purerl.types import Array

READINGS = ("xpos", "xmat", "subtree_com")
STANDING_HEIGHT = 0.522  # [m] of the torso in the walker's own model


@dataclasses.dataclass(frozen=True)
class Options:
    """Settings of the task."""

    forward_weight: float = 1.0  # reward for 1 m/s along x, per control step
    healthy_reward: float = 1.0  # reward for each control step that ends healthy
    healthy_height: tuple[float, float] = (0.25, 1.2)  # [m] of the torso; outside has ended
    healthy_up: float = 0.0  # least z of the torso's up-axis: an ant on its back has ended
    control_weight: float = 0.1  # reward taken for the sum of squared actions
    reset_noise: float = 0.1  # half-width of the start [rad, m/s, rad/s]
    physics_timestep: float = 0.005  # [s]
    substeps: int = 5  # physics steps in one control step


@dataclasses.dataclass(frozen=True)
class AntRun:
    """The environment; `build` makes one."""

    options: Options
    physics: Physics
    torso: int  # body id
    feet: tuple[int, ...]  # body ids
    joints: tuple[int, ...]  # of qpos
    dofs: tuple[int, ...]  # of qvel
    action_size: int

    @property
    def control_timestep(self) -> float:
        """Simulated time of one step [s]."""
        return self.physics.control_timestep

    def reset(self, key: Array) -> State:
        """Starts standing at the origin, limbs and velocities drawn around rest."""
        model, noise = self.physics.model, self.options.reset_noise
        limbs_key, velocity_key = jax.random.split(key)
        limbs = jax.random.uniform(limbs_key, (len(self.joints),), minval=-noise, maxval=noise)
        qvel = jax.random.uniform(velocity_key, (model.nv,), minval=-noise, maxval=noise)
        qpos = jnp.asarray(model.qpos0, jnp.float32).at[jnp.array(self.joints)].add(limbs)
        physics, readings = self.physics.init(qpos, qvel)
        action = jnp.zeros(self.action_size, jnp.float32)
        return self._state(physics, readings, jnp.zeros((), jnp.float32), action)

    def step(self, state: State, action: Array) -> State:
        """Drives the eight joints with action [8] in [-1, 1]."""
        ctrl = lookup.scale_action(self.physics.model, action)
        physics, readings = self.physics.step(state.physics, ctrl)
        center = readings.subtree_com[self.torso, 0]
        speed = (center - state.task["center"]) / self.control_timestep
        return self._state(physics, readings, speed, action)

    def _state(self, physics: PhysicsState, readings, speed: Array, action: Array) -> State:
        height, up = readings.xpos[self.torso, 2], readings.xmat[self.torso, 2, 2]
        healthy = is_healthy(height, up, self.options)
        terms = reward_terms(speed, healthy, action, self.options)
        return State(
            physics=physics,
            observation=self._observe(physics, readings, action),
            reward=sum(terms.values()),
            terminated=~healthy,
            truncated=jnp.zeros((), bool),
            metrics={
                "forward_velocity": speed,
                "height": height,
                "healthy": healthy.astype(jnp.float32),
                "control_cost": -terms["control"],
            },
            task={"center": readings.subtree_com[self.torso, 0]},
        )

    def _observe(self, physics: PhysicsState, readings, action: Array) -> Array:
        """Returns [O] what the ant can feel: nothing here depends on where in the world it is."""
        to_body = readings.xmat[self.torso].T
        feet = readings.xpos[jnp.array(self.feet)] - readings.xpos[self.torso]
        parts = (
            readings.xpos[self.torso, 2:],
            readings.xmat[self.torso].ravel(),
            physics.qpos[jnp.array(self.joints)],
            to_body @ physics.qvel[:3],
            physics.qvel[3:6],  # MuJoCo keeps a free joint's rotation in the body's own frame
            physics.qvel[jnp.array(self.dofs)],
            (feet @ to_body.T).ravel(),
            action,
        )
        return jnp.concatenate(parts)


def is_healthy(height: Array, up: Array, options: Options) -> Array:
    """Says whether the ant can go on, [] bool: neither fallen, nor thrown up, nor on its back."""
    low, high = options.healthy_height
    return (height > low) & (height < high) & (up > options.healthy_up)


def reward_terms(speed: Array, healthy: Array, action: Array, options: Options) -> dict[str, Array]:
    """Returns the reward as its terms, [] each: forward speed [m/s], health, control cost."""
    return {
        "forward": options.forward_weight * speed,
        "healthy": options.healthy_reward * healthy.astype(jnp.float32),
        "control": -options.control_weight * jnp.sum(action**2),
    }


def build_model(options: Options, engine: str) -> mujoco.MjModel:
    """Composes dm_control's ant and a floor, and compiles them."""
    root, walker = mjcf.RootElement(model="floor"), ant.Ant().mjcf_model
    root.worldbody.add("light", pos=(0, 0, 10), dir=(0, 0, -1), directional=True)
    root.worldbody.add("geom", name="floor", type="plane", size=(50, 50, 1), rgba=(0.6,) * 3 + (1,))
    # The free joint moves the frame of the attachment: with the torso at its origin, qpos[:3] and
    # qvel[:3] are the torso's own, and not those of a point half a metre below it.
    walker.find("body", "torso").pos = (0, 0, 0)
    frame = root.attach(walker)
    frame.pos = (0, 0, STANDING_HEIGHT)
    frame.add("freejoint", name="root")
    model = mjcf.Physics.from_mjcf_model(root).model.ptr
    model.opt.timestep = options.physics_timestep
    lookup.use_pyramidal_cone(model)
    lookup.disable_sensors(model)
    set_solver(model, engine)
    return model


def set_solver(model: mujoco.MjModel, engine: str) -> None:
    """Chooses Newton's iterations for an engine: to convergence in C, few in MJX."""
    iterations, line_search = (100, 50) if choose_engine(engine) == "c" else (4, 8)
    lookup.limit_solver(model, iterations, line_search)


def build(options: Options = Options(), engine: str = "auto") -> AntRun:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics`."""
    model = build_model(options, engine)
    joints = [name for name in lookup.names(model, "joint") if name.endswith(("_hip", "_ankle"))]
    feet = ("front_left_foot", "front_right_foot", "back_right_foot", "back_left_foot")
    return AntRun(
        options=options,
        physics=Physics(model, READINGS, options.substeps, engine),
        torso=lookup.find(model, "body", "walker/torso"),
        feet=tuple(lookup.find(model, "body", f"walker/{name}") for name in feet),
        joints=tuple(lookup.qpos_indices(model, joints).tolist()),
        dofs=tuple(lookup.qvel_indices(model, joints).tolist()),
        action_size=model.nu,
    )
