"""Do as told: the rodent runs, turns, rears or stands, as a command says that changes on the way.

A command is a speed ahead, a rate of turning and a height of the head. Each is drawn in the
episode, holds for some seconds, and is part of the observation. What is rewarded is how near the
body comes to it, as in the joystick tasks of MuJoCo Playground (Zakka et al. 2025,
arXiv:2502.08844).
"""

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp

from purerl import Array, Physics, PhysicsState, State, lookup, overflow_metric, overflow_reading
from purerl.envs.arenas import Floor
from purerl.envs.bodies import RODENT
from purerl.envs.compose import PREFIX, Composed, compose
from purerl.envs.feeling import READINGS, felt
from purerl.envs.randomization import draw_stance

# Each kind of command: least and most speed ahead [m/s], rate of turning [rad/s], and height of the
# head [m]; it stands with its head at 0.072.
COMMANDS = {
    "run": ((0.4, 1.2), (0.0, 0.0), (0.07, 0.07)),
    "turn": ((0.1, 0.5), (1.0, 2.5), (0.07, 0.07)),
    "rear": ((0.0, 0.0), (0.0, 0.0), (0.11, 0.13)),
    "stop": ((0.0, 0.0), (0.0, 0.0), (0.07, 0.07)),
}
# How far off each of the three earns nothing of its reward, and its share of the reward. Between
# they are lines: where exp(-(off / width)^2) was flat, nothing was learned in 0.8 M steps.
WIDTHS, SHARES = (1.0, 4.0, 0.05), (0.5, 0.25, 0.25)


@dataclasses.dataclass(frozen=True)
class Options:
    """Settings of the task."""

    command: Literal["any", "run", "turn", "rear", "stop"] = "any"
    """One kind of command alone, or any of them."""
    hold: float = 2.5
    """How long a command holds [s]."""
    control_weight: float = 0.01
    """Reward taken for the sum of squared actions."""
    reset_noise: float = 0.01
    """Half-width of the start's noise [rad, m/s, rad/s]."""
    substeps: int = 5
    """Physics steps in one control step."""

    def __post_init__(self):
        """Refuses a command that never holds."""
        if not self.hold > 0.0:
            raise ValueError(f"hold is {self.hold}; it must be above 0 [s].")


@dataclasses.dataclass(frozen=True)
class Joystick:
    """The environment; `build` makes one."""

    options: Options
    physics: Physics
    parts: Composed
    action_size: int

    @property
    def control_timestep(self) -> float:
        """Simulated time of one step [s]."""
        return self.physics.control_timestep

    def reset(self, key: Array) -> State:
        """Starts standing, limbs and velocities drawn around rest, under a first command."""
        limbs_key, velocity_key, command_key = jax.random.split(key, 3)
        noise = self.options.reset_noise
        start = draw_stance(limbs_key, velocity_key, self.parts, noise)
        physics, readings = self.physics.init(*start)
        task = {"commands": command_key, "command": self._command(command_key, physics.time)}
        return self._state(physics, readings, task, jnp.zeros(self.action_size))

    def step(self, state: State, action: Array) -> State:
        """Drives the actuators with action [A] in [-1, 1]."""
        ctrl = lookup.scale_action(self.physics.model, action)
        physics, readings = self.physics.step(state.physics, ctrl)
        return self._state(physics, readings, state.task, action)

    def _command(self, key: Array, time: Array) -> Array:
        """Returns the command that holds at a time, [3]: each has a key of the episode's own."""
        number = jnp.floor(time / self.options.hold + 1e-3).astype(jnp.int32)
        return draw_command(jax.random.fold_in(key, number), self.options.command)

    def _state(self, physics: PhysicsState, readings: Any, task: dict, action: Array) -> State:
        torso = self.parts.torso
        axes, height = readings.xmat[torso], readings.xpos[torso, 2]
        head = readings.site_xpos[lookup.find(self.physics.model, "site", PREFIX + "head"), 2]
        ahead, aside = along_heading(axes, readings.subtree_linvel[torso])
        moved = jnp.stack([ahead, axes[2] @ physics.qvel[3:6], head])
        near = nearness(moved, aside, task["command"])
        cost = self.options.control_weight * jnp.square(action).sum()
        healthy = (height > RODENT.healthy_height[0]) & (height < RODENT.healthy_height[1])
        names = ("speed", "turning", "head")
        metrics = {f"near_{name}": x for name, x in zip(names, near, strict=True)}
        metrics |= {"speed": ahead, "turning": moved[1], "head_height": head}
        command = self._command(task["commands"], physics.time)
        parts = felt(self.parts, physics, readings, action)
        return State(
            physics=physics,
            observation=jnp.concatenate([*parts, command]),
            reward=(near * jnp.array(SHARES)).sum() - cost,
            terminated=~healthy,
            truncated=jnp.zeros((), bool),
            metrics=metrics | overflow_metric(readings),
            task=task | {"command": command},
        )


def draw_command(key: Array, kind: str) -> Array:
    """Draws a command [3]: speed ahead [m/s], rate of turning [rad/s], height of the head [m]."""
    kind_key, side_key, value_key = jax.random.split(key, 3)
    ranges = jnp.array(list(COMMANDS.values()) if kind == "any" else [COMMANDS[kind]])
    low, high = ranges[jax.random.randint(kind_key, (), 0, len(ranges))].T
    side = jnp.where(jax.random.bernoulli(side_key), 1.0, -1.0)  # left, right
    told = jax.random.uniform(value_key, (3,), minval=low, maxval=high)
    return told * jnp.stack([jnp.ones(()), side, jnp.ones(())])


def along_heading(axes: Array, velocity: Array) -> tuple[Array, Array]:
    """Returns a velocity [3] ahead and to the left, [] each [m/s], seen from above.

    `axes` [3, 3] are the torso's in its columns; a torso that points straight up heads nowhere.
    """
    ahead = axes[:2, 0] / jnp.maximum(jnp.linalg.norm(axes[:2, 0]), 1e-3)
    return velocity[:2] @ ahead, velocity[1] * ahead[0] - velocity[0] * ahead[1]


def nearness(moved: Array, aside: Array, command: Array) -> Array:
    """Returns how near a body comes to a command, [3] in [0, 1], 1 where it is met.

    Args:
      moved: [3] what it does, in the command's order and units.
      aside: [] its speed to the left [m/s], which should be none.
      command: [3].
    """
    off = jnp.abs(moved - command) / jnp.array(WIDTHS)
    return jnp.clip(1.0 - off - jnp.array([1.0, 0.0, 0.0]) * jnp.abs(aside) / WIDTHS[0], 0.0, 1.0)


def build(options: Options = Options(), engine: str = "auto") -> Joystick:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    parts = compose(RODENT, Floor(), engine)
    readings = (*READINGS, "site_xpos", "subtree_linvel", *overflow_reading(engine))
    physics = Physics(parts.model, readings, options.substeps, engine)
    return Joystick(options, physics, parts, parts.model.nu)
