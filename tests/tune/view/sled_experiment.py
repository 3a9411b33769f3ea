"""A box that a motor moves along x, in the air: with options of every kind that a slider meets.

The floor below it, which it cannot touch, is there for its shadow.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from purerl import Array, Config, Evaluation, Experiment, Physics, State, networks

XML = """
<mujoco>
  <option gravity="0 0 0" timestep="0.01"/>
  <worldbody>
    <geom name="floor" type="plane" pos="0 0 -0.4" size="3 3 0.1" contype="0" conaffinity="0"/>
    <body name="box">
      <joint name="x" type="slide" axis="1 0 0" damping="0.2"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom name="box" type="box" mass="0.5" size="{width} 0.3 0.3" rgba="0.8 0.4 0.1 1"/>
    </body>
  </worldbody>
  <actuator><motor joint="x" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


@dataclasses.dataclass(frozen=True)
class Options:
    bonus: float = 1.0
    weights: tuple[float, float] = (0.5, 0.25)
    limit: float = 100.0
    width: float = 0.3
    span: tuple[float, float] = (0.0, 1.0)

    def __post_init__(self) -> None:
        if not self.span[0] < self.span[1]:
            raise ValueError(f"span is {self.span}; give least < greatest.")


@dataclasses.dataclass(frozen=True)
class Sled:
    options: Options
    physics: Any
    action_size = 1
    control_timestep = 0.02

    def reset(self, key: Array) -> State:
        start = jax.random.uniform(key, (3,), minval=-0.01, maxval=0.01)
        physics, _ = self.physics.init(start, jnp.zeros(3))
        return self._state(physics)

    def step(self, state: State, action: Array) -> State:
        return self._state(self.physics.step(state.physics, action)[0])

    def _state(self, physics) -> State:
        near, slow = self.options.weights
        terms = {
            "reward_bonus": jnp.float32(self.options.bonus),
            "reward_near": -near * jnp.abs(physics.qpos[0]),
            "reward_slow": -slow * jnp.abs(physics.qvel[0]),
        }
        return State(
            physics=physics,
            observation=jnp.concatenate([physics.qpos, physics.qvel]),
            reward=sum(terms.values()),
            terminated=jnp.abs(physics.qpos[0]) >= self.options.limit,
            truncated=jnp.zeros((), bool),
            metrics=terms | {"height": physics.qpos[2]},
            task=(),
        )


def build(options: Options, engine: str) -> Sled:
    if not 0 < options.width < 1:
        raise ValueError(f"width is {options.width}; it must be above 0 and below 1.")
    model = mujoco.MjModel.from_xml_string(XML.format(width=options.width))
    return Sled(options, Physics(model, (), 2, engine))


experiment = Experiment(
    build_env=build,
    env=Options(),
    build_network=networks.mlp,
    network=networks.MlpOptions(policy_hidden=(8,), value_hidden=(8,)),
    ppo=Config(
        num_steps=96,
        num_envs=4,
        rollout_length=8,
        num_epochs=1,
        num_minibatches=2,
        episode_length=10_000,
    ),  # fmt: skip
    evaluation=Evaluation(num_episodes=1, number=0),
)
