"""Cheetah: a planar body that runs; full reward at 10 m/s. 10 ms a step."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from dm_control.suite import cheetah

from purerl import Array, Physics, choose_engine, lookup, overflow_reading
from purerl.envs.suite.base import Moment, Start, SuiteEnv, load_model, make_env
from purerl.envs.suite.rewards import tolerance

RUN_SPEED = 10.0  # [m/s]
SETTLING = 200  # physics steps from the random pose to the start of the episode
READINGS = ("sensordata",)


@dataclass(frozen=True)
class Options:
    """Settings of the task: none."""


@dataclass(frozen=True)
class Cheetah:
    """The domain; `build` makes an environment of it."""

    settling: Physics
    speed: slice  # in sensordata

    def start(self, key: Array) -> Start:
        """A random pose, fallen to the ground for two seconds."""
        model = self.settling.model
        low, high = np.where(model.jnt_limited[:, None], model.jnt_range, model.qpos0[:, None]).T
        qpos = low + (high - low) * jax.random.uniform(key, (model.nq,))
        physics, _ = self.settling.init(qpos, jnp.zeros(model.nv))
        still = jnp.zeros(model.nu)
        calls = SETTLING // self.settling.substeps
        fall = lambda _, now: self.settling.step(now, still)[0]  # noqa: E731
        physics = jax.lax.fori_loop(0, calls, fall, physics)
        return Start(physics.qpos, physics.qvel, {})

    def observe(self, moment: Moment) -> Array:
        """Positions without x, velocities: [17]."""
        return jnp.concatenate([moment.physics.qpos[1:], moment.physics.qvel])

    def reward(self, moment: Moment) -> dict[str, Array]:
        """Speed, up to `RUN_SPEED`."""
        speed = moment.readings.sensordata[self.speed][0]
        reward = tolerance(
            speed, (RUN_SPEED, np.inf), margin=RUN_SPEED, value_at_margin=0, sigmoid="linear"
        )
        return {"reward": reward, "speed": speed}


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    model = load_model(cheetah.Physics, cheetah.get_model_and_assets(), engine)
    speed = lookup.sensor_slice(model, "torso_subtreelinvel")
    if choose_engine(engine) == "c":  # which makes all of them in one call
        settling = Physics(model, (), SETTLING, engine)
        return make_env(Cheetah(settling, speed), model, READINGS, 0.01, engine)
    # Steps of the environment: a kernel of 200 is too far from XLA's to be taken, and by XLA starts
    # took five sixths of a training's time.
    physics = Physics(model, (*READINGS, *overflow_reading(engine)), 1, engine)
    return SuiteEnv(Cheetah(physics, speed), physics, model.nu)
