"""Pendulum: swing up and balance, with a motor too weak to lift it at once. 20 ms a step."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from dm_control.suite import pendulum

from purerl import Array, lookup
from purerl.envs.suite.base import Moment, Start, SuiteEnv, load_model, make_env
from purerl.envs.suite.rewards import tolerance

READINGS = ("xmat",)
UPRIGHT = float(np.cos(np.deg2rad(8)))  # cosine of the angle within which it is up


@dataclass(frozen=True)
class Options:
    """Settings of the task: none."""


@dataclass(frozen=True)
class Pendulum:
    """The domain; `build` makes an environment of it."""

    pole: int  # body

    def start(self, key: Array) -> Start:
        """At any angle, at rest."""
        angle = jax.random.uniform(key, (1,), minval=-np.pi, maxval=np.pi)
        return Start(angle, jnp.zeros(1), {})

    def observe(self, moment: Moment) -> Array:
        """Cosine and sine of the angle, velocity: [3]."""
        pole = moment.readings.xmat[self.pole]
        return jnp.concatenate([jnp.stack([pole[2, 2], pole[0, 2]]), moment.physics.qvel])

    def reward(self, moment: Moment) -> dict[str, Array]:
        """1 within 8 degrees of upright."""
        upright = moment.readings.xmat[self.pole, 2, 2]
        return {"reward": tolerance(upright, (UPRIGHT, 1.0)), "upright": upright}


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    model = load_model(pendulum.Physics, pendulum.get_model_and_assets(), engine)
    return make_env(Pendulum(lookup.find(model, "body", "pole")), model, READINGS, 0.02, engine)
