"""Point mass: push a ball in a plane to the middle, and hold it there. 20 ms a step."""

from dataclasses import dataclass

import jax.numpy as jnp
import mujoco
from dm_control.suite import point_mass

from purerl import Array, lookup
from purerl.envs.suite.base import Moment, Start, SuiteEnv, load_model, make_env, random_joints
from purerl.envs.suite.rewards import tolerance

READINGS = ("geom_xpos",)


@dataclass(frozen=True)
class Options:
    """Settings of the task: none."""


@dataclass(frozen=True)
class PointMass:
    """The domain; `build` makes an environment of it."""

    model: mujoco.MjModel
    mass: int  # geom
    target: int  # geom

    def start(self, key: Array) -> Start:
        """Anywhere, at rest."""
        return Start(random_joints(self.model, key), jnp.zeros(self.model.nv), {})

    def observe(self, moment: Moment) -> Array:
        """Position and velocity: [4]."""
        return jnp.concatenate([moment.physics.qpos, moment.physics.qvel])

    def reward(self, moment: Moment) -> dict[str, Array]:
        """The mass at the target, a fifth of it for little force."""
        places, size = moment.readings.geom_xpos, float(self.model.geom_size[self.target, 0])
        distance = jnp.linalg.norm(places[self.target] - places[self.mass])
        near = tolerance(distance, (0.0, size), margin=size)
        force = tolerance(moment.ctrl, margin=1, value_at_margin=0, sigmoid="quadratic")
        return {"reward": near * (force.mean() + 4) / 5, "distance": distance}


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    model = load_model(point_mass.Physics, point_mass.get_model_and_assets(), engine)
    mass, target = (lookup.find(model, "geom", name) for name in ("pointmass", "target"))
    return make_env(PointMass(model, mass, target), model, READINGS, 0.02, engine)
