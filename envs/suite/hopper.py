"""Hopper: one planar leg that stands, or hops at 2 m/s. 20 ms a step."""

from dataclasses import dataclass

import jax.numpy as jnp
import mujoco
import numpy as np
from dm_control.suite import hopper

from purerl import Array, lookup
from purerl.envs.suite.base import (
    Moment,
    Start,
    SuiteEnv,
    check_task,
    load_model,
    make_env,
    random_joints,
)
from purerl.envs.suite.rewards import tolerance

TASKS = ("stand", "hop")
STAND_HEIGHT = 0.6  # torso above foot [m]
HOP_SPEED = 2.0  # [m/s]
READINGS = ("xipos", "sensordata")


@dataclass(frozen=True)
class Options:
    """Settings of the task."""

    task: str = "hop"  # "stand" or "hop"


@dataclass(frozen=True)
class Hopper:
    """The domain; `build` makes an environment of it."""

    task: str
    model: mujoco.MjModel
    torso: int  # body
    foot: int  # body
    speed: slice  # in sensordata
    touch: tuple[int, int]  # toe and heel, in sensordata

    def start(self, key: Array) -> Start:
        """Any pose, at rest."""
        return Start(random_joints(self.model, key), jnp.zeros(self.model.nv), {})

    def observe(self, moment: Moment) -> Array:
        """Positions without x, velocities, log(1 + force [N]) of toe and heel: [15]."""
        touch = jnp.log1p(moment.readings.sensordata[jnp.array(self.touch)])
        return jnp.concatenate([moment.physics.qpos[1:], moment.physics.qvel, touch])

    def reward(self, moment: Moment) -> dict[str, Array]:
        """Standing, times hopping forward or using little force."""
        xipos = moment.readings.xipos
        height = xipos[self.torso, 2] - xipos[self.foot, 2]
        speed = moment.readings.sensordata[self.speed][0]
        standing = tolerance(height, (STAND_HEIGHT, 2.0))
        if self.task == "hop":
            hopping = tolerance(
                speed, (HOP_SPEED, np.inf), HOP_SPEED / 2, value_at_margin=0.5, sigmoid="linear"
            )
            reward = standing * hopping
        else:
            force = tolerance(moment.ctrl, margin=1, value_at_margin=0, sigmoid="quadratic")
            reward = standing * (force.mean() + 4) / 5
        return {"reward": reward, "height": height, "speed": speed}


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    check_task(options.task, TASKS)
    model = load_model(hopper.Physics, hopper.get_model_and_assets(), engine)
    touch = tuple(lookup.sensor_slice(model, f"touch_{part}").start for part in ("toe", "heel"))
    domain = Hopper(
        task=options.task,
        model=model,
        torso=lookup.find(model, "body", "torso"),
        foot=lookup.find(model, "body", "foot"),
        speed=lookup.sensor_slice(model, "torso_subtreelinvel"),
        touch=touch,
    )
    return make_env(domain, model, READINGS, 0.02, engine)
