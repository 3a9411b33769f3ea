"""Gymnasium's Ant-v5 as an environment of this library: for comparing trainers on one body.

Model, substeps, observation, reward, termination and starts are Gymnasium's (a test compares them
with Gymnasium's own environment). Two figures are taken at another instant of the same step: the
contact forces before the last substep instead of at the last stage of its integrator, and the speed
from the torso's position in the state itself. Needs the `peers` extra.
"""

import dataclasses
from importlib import resources

import jax
import jax.numpy as jnp
import mujoco

from purerl import Array, Physics, PhysicsState, State, lookup


@dataclasses.dataclass(frozen=True)
class Options:
    """The settings that Gymnasium's Ant has under the same names."""

    ctrl_cost_weight: float = 0.5
    """Reward taken for the sum of squared actions."""
    contact_cost_weight: float = 5e-4
    """Reward taken for the sum of squared contact forces, each clipped to [-1, 1]."""
    healthy_reward: float = 1.0
    """Reward for each control step that ends healthy."""
    healthy_z_range: tuple[float, float] = (0.2, 1.0)
    """Height of the torso outside of which an episode ends [m]."""
    reset_noise_scale: float = 0.1
    """Start: half-width of the noise on positions, deviation of that on velocities."""


@dataclasses.dataclass(frozen=True)
class GymnasiumAnt:
    """The environment; `build` makes one."""

    options: Options
    physics: Physics
    root: tuple[int, ...]  # of qpos: where the torso's x, y, z and quaternion stand
    action_size: int

    @property
    def control_timestep(self) -> float:
        """Simulated time of one step [s]."""
        return self.physics.control_timestep

    def reset(self, key: Array) -> State:
        """Starts around the model's rest, every position and velocity with noise."""
        position_key, velocity_key = jax.random.split(key)
        model, scale = self.physics.model, self.options.reset_noise_scale
        noise = jax.random.uniform(position_key, (model.nq,), minval=-scale, maxval=scale)
        qpos = jnp.asarray(model.qpos0, jnp.float32) + noise
        qvel = scale * jax.random.normal(velocity_key, (model.nv,))
        physics, readings = self.physics.init(qpos, qvel)
        # Gymnasium computes contact forces only in a step.
        still, forces = jnp.zeros(self.action_size), jnp.zeros_like(readings.cfrc_ext)
        return self._state(physics, forces, still, jnp.zeros(()))

    def step(self, state: State, action: Array) -> State:
        """Drives the motors with action [8] in [-1, 1]."""
        ctrl = lookup.scale_action(self.physics.model, action)
        physics, readings = self.physics.step(state.physics, ctrl)
        gained = physics.qpos[self.root[0]] - state.physics.qpos[self.root[0]]
        return self._state(physics, readings.cfrc_ext, ctrl, gained / self.control_timestep)

    def _state(self, physics: PhysicsState, forces: Array, ctrl: Array, speed: Array) -> State:
        """Observes and rewards; forces [nbody, 6] [N m, N], speed [m/s] along x."""
        options, forces = self.options, jnp.clip(forces, -1.0, 1.0)
        low, high = options.healthy_z_range
        height = physics.qpos[self.root[2]]
        healthy = (height >= low) & (height <= high)
        effort = options.ctrl_cost_weight * jnp.sum(ctrl**2)
        effort += options.contact_cost_weight * jnp.sum(forces**2)
        # x and y are not felt; the first body is the world.
        felt = (physics.qpos[2:], physics.qvel, forces[1:].ravel())
        return State(
            physics=physics,
            observation=jnp.concatenate(felt),
            reward=speed + options.healthy_reward * healthy - effort,
            terminated=~healthy,
            truncated=jnp.zeros((), bool),
            metrics={"forward_speed": speed},
            task=(),
        )


def load_model() -> mujoco.MjModel:
    """Compiles the ant of the installed Gymnasium."""
    folder = resources.files("gymnasium.envs.mujoco") / "assets"
    spec = mujoco.MjSpec.from_file(str(folder / "ant.xml"))
    # MuJoCo computes contact forces on bodies only for a sensor's sake; Gymnasium asks by hand.
    torso = spec.body("torso")
    torso.add_site(name="torso")
    kind, site = mujoco.mjtSensor.mjSENS_ACCELEROMETER, mujoco.mjtObj.mjOBJ_SITE
    spec.add_sensor(name="acceleration", type=kind, objtype=site, objname="torso")
    return spec.compile()


def build(options: Options = Options(), engine: str = "auto") -> GymnasiumAnt:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    model = load_model()
    root = tuple(lookup.qpos_indices(model, ["root"]).tolist())
    physics = Physics(model, ("cfrc_ext",), substeps=5, engine=engine)
    return GymnasiumAnt(options, physics, root, model.nu)
