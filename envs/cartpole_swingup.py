"""Swing a hanging pole up with a cart, and balance it: the smallest task worth learning.

One control step is two physics steps of 10 ms. Nothing ends an episode but the trainer's time
limit: with 1000 steps (20 s) a return is at most 1000.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco

from purerl import Array, Physics, PhysicsState, State, lookup

XML = Path(__file__).parent.parent / "assets" / "cartpole.xml"


@dataclasses.dataclass(frozen=True)
class Options:
    """Settings of the task."""

    substeps: int = 2  # physics steps of 10 ms in one control step
    reset_noise: float = 0.05  # [rad, m] half-width of the start around hanging at rest
    velocity_scale: float = 5.0  # [rad/s] a pole this fast has half of the reward for slowness


@dataclasses.dataclass(frozen=True)
class CartpoleSwingup:
    """The environment; `build` makes one."""

    options: Options
    physics: Physics
    slide: int  # of qpos and qvel, both have one number a joint
    hinge: int

    action_size = 1

    @property
    def control_timestep(self) -> float:
        """Simulated time of one step [s]."""
        return self.physics.control_timestep

    def reset(self, key: Array) -> State:
        """Starts with the pole hanging, moved and set swinging a little."""
        noise = self.options.reset_noise
        start = jax.random.uniform(key, (2, 2), jnp.float32, minval=-noise, maxval=noise)
        physics, _ = self.physics.init(start[0], start[1])
        return self._state(physics, jnp.zeros(1, jnp.float32))

    def step(self, state: State, action: Array) -> State:
        """Pushes the cart with action [1] in [-1, 1]."""
        ctrl = lookup.scale_action(self.physics.model, action)
        physics, _ = self.physics.step(state.physics, ctrl)
        return self._state(physics, action)

    def _state(self, physics: PhysicsState, action: Array) -> State:
        position, angle = physics.qpos[self.slide], physics.qpos[self.hinge]
        speed, spin = physics.qvel[self.slide], physics.qvel[self.hinge]
        upright = 0.5 * (1.0 - jnp.cos(angle))
        return State(
            physics=physics,
            observation=jnp.stack([position, jnp.cos(angle), jnp.sin(angle), speed, spin]),
            reward=reward(upright, position, spin, action[0], self.options.velocity_scale),
            terminated=jnp.zeros((), bool),
            truncated=jnp.zeros((), bool),
            metrics={"upright": upright, "centered": _bump(position)},
            task=(),
        )


def reward(upright: Array, position: Array, spin: Array, push: Array, velocity_scale: float):
    """Returns the reward [] in [0, 1]: upright, in the middle, slow and without effort.

    Each factor is smooth, and only `upright` can reach 0: whatever the cart does, a higher pole is
    worth more, which is what leads the way from hanging to upright.

    Args:
      upright: [] 0 hanging, 1 standing.
      position: [] of the cart [m].
      spin: [] of the pole [rad/s].
      push: [] action in [-1, 1].
      velocity_scale: [rad/s] at which slowness is worth a half.
    """
    centered = 0.5 + 0.5 * _bump(position)
    # A pole must be fast to get up: only a standing one is asked to be slow.
    slow = 1.0 - upright * (1.0 - 1.0 / (1.0 + (spin / velocity_scale) ** 2))
    gentle = 1.0 - 0.1 * jnp.clip(push, -1.0, 1.0) ** 2
    return upright * centered * slow * gentle


def _bump(position: Array) -> Array:
    """1 in the middle of the rail, a half at 1 m."""
    return 1.0 / (1.0 + position**2)


def build(options: Options = Options(), engine: str = "auto") -> CartpoleSwingup:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    model = mujoco.MjModel.from_xml_path(str(XML))
    physics = Physics(model, (), options.substeps, engine)
    return CartpoleSwingup(
        options=options,
        physics=physics,
        slide=int(lookup.qpos_indices(model, ["slide"])[0]),
        hinge=int(lookup.qpos_indices(model, ["hinge"])[0]),
    )
