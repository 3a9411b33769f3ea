"""Reacher: a two-link arm brings its finger to a target, large (easy) or small (hard).

20 ms a step. The target is another one in each episode: a model field of that environment.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from dm_control.suite import reacher

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

TARGET_SIZES = {"easy": 0.05, "hard": 0.015}  # radius [m]
READINGS = ("geom_xpos",)


@dataclass(frozen=True)
class Options:
    """Settings of the task."""

    task: str = "easy"  # "easy" or "hard"


@dataclass(frozen=True)
class Reacher:
    """The domain; `build` makes an environment of it."""

    model: mujoco.MjModel
    target: int  # geom
    finger: int  # geom

    def start(self, key: Array) -> Start:
        """Any pose, and a target anywhere in reach."""
        pose_key, angle_key, radius_key = jax.random.split(key, 3)
        angle = jax.random.uniform(angle_key, maxval=2 * np.pi)
        radius = jax.random.uniform(radius_key, minval=0.05, maxval=0.20)
        place = radius * jnp.stack([jnp.sin(angle), jnp.cos(angle)])
        geom_pos = jnp.float32(self.model.geom_pos).at[self.target, :2].set(place)
        qpos = random_joints(self.model, pose_key)
        return Start(qpos, jnp.zeros(self.model.nv), {"geom_pos": geom_pos})

    def observe(self, moment: Moment) -> Array:
        """Joint angles, vector from finger to target, velocities: [6]."""
        return jnp.concatenate([moment.physics.qpos, self._to_target(moment), moment.physics.qvel])

    def reward(self, moment: Moment) -> dict[str, Array]:
        """1 where the finger touches the target."""
        touching = float(self.model.geom_size[[self.target, self.finger], 0].sum())
        distance = jnp.linalg.norm(self._to_target(moment))
        return {"reward": tolerance(distance, (0.0, touching)), "distance": distance}

    def _to_target(self, moment: Moment) -> Array:
        places = moment.readings.geom_xpos
        return places[self.target, :2] - places[self.finger, :2]


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    check_task(options.task, tuple(TARGET_SIZES))
    model = load_model(reacher.Physics, reacher.get_model_and_assets(), engine)
    target, finger = (lookup.find(model, "geom", name) for name in ("target", "finger"))
    model.geom_size[target, 0] = TARGET_SIZES[options.task]
    return make_env(Reacher(model, target, finger), model, READINGS, 0.02, engine)
