"""Walker: two planar legs that stand, walk at 1 m/s or run at 8 m/s. 25 ms a step."""

from dataclasses import dataclass

import jax.numpy as jnp
import mujoco
import numpy as np
from dm_control.suite import walker

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

SPEEDS = {"stand": 0.0, "walk": 1.0, "run": 8.0}  # [m/s]
STAND_HEIGHT = 1.2  # of the torso [m]
READINGS = ("xpos", "xmat", "sensordata")


@dataclass(frozen=True)
class Options:
    """Settings of the task."""

    task: str = "walk"  # "stand", "walk" or "run"


@dataclass(frozen=True)
class Walker:
    """The domain; `build` makes an environment of it."""

    target_speed: float  # [m/s]; 0 to stand
    model: mujoco.MjModel
    torso: int  # body
    speed: slice  # in sensordata

    def start(self, key: Array) -> Start:
        """Any pose, at rest."""
        return Start(random_joints(self.model, key), jnp.zeros(self.model.nv), {})

    def observe(self, moment: Moment) -> Array:
        """Orientation of each body in the plane, torso height, velocities: [24]."""
        turned = moment.readings.xmat[1:, 0, :][:, jnp.array([0, 2])].ravel()
        height = moment.readings.xpos[self.torso, 2:]
        return jnp.concatenate([turned, height, moment.physics.qvel])

    def reward(self, moment: Moment) -> dict[str, Array]:
        """Standing upright, and most of it for speed."""
        height = moment.readings.xpos[self.torso, 2]
        speed = moment.readings.sensordata[self.speed][0]
        standing = tolerance(height, (STAND_HEIGHT, np.inf), STAND_HEIGHT / 2)
        upright = (1 + moment.readings.xmat[self.torso, 2, 2]) / 2
        reward = (3 * standing + upright) / 4
        if self.target_speed:
            bounds, margin = (self.target_speed, np.inf), self.target_speed / 2
            moving = tolerance(speed, bounds, margin, value_at_margin=0.5, sigmoid="linear")
            reward = reward * (5 * moving + 1) / 6
        return {"reward": reward, "height": height, "speed": speed}


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    check_task(options.task, tuple(SPEEDS))
    model = load_model(walker.Physics, walker.get_model_and_assets(), engine)
    domain = Walker(
        target_speed=SPEEDS[options.task],
        model=model,
        torso=lookup.find(model, "body", "torso"),
        speed=lookup.sensor_slice(model, "torso_subtreelinvel"),
    )
    return make_env(domain, model, READINGS, 0.025, engine)
